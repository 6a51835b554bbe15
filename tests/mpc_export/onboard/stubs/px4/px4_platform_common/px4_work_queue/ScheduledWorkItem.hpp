#pragma once
#include <cstdint>
namespace px4 {
struct wq_config_t {
  const char *name;
};
namespace wq_configurations {
static constexpr wq_config_t rate_ctrl{"wq:rate_ctrl"};
}
class ScheduledWorkItem {
 public:
  virtual ~ScheduledWorkItem() = default;
  void ScheduleOnInterval(uint32_t us, uint32_t = 0) { interval = us, scheduled = this; }
  void ScheduleClear() { scheduled = nullptr; }
  static void run() { scheduled->Run(); }
  inline static uint32_t interval = 0;

 protected:
  explicit ScheduledWorkItem(const char *, const wq_config_t &) {}
  virtual void Run() = 0;

 private:
  inline static ScheduledWorkItem *scheduled = nullptr;
};
}  // namespace px4
