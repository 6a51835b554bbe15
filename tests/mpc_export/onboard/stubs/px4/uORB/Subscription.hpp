#pragma once
#include <cstddef>
#include <cstring>

struct orb_metadata {
  std::size_t size;
  unsigned generation = 0;
  unsigned char data[1024] = {};
  explicit orb_metadata(std::size_t n) : size(n) {}
};
typedef orb_metadata *orb_id_t;
#define ORB_ID(name) (&orb_##name)
#define STUB_TOPIC(name) inline orb_metadata orb_##name{sizeof(name##_s)}

namespace uORB {
class Subscription {
 public:
  explicit Subscription(orb_id_t topic) : topic_(topic) {}
  bool updated() const { return topic_->generation != seen_; }
  bool copy(void *to) {
    std::memcpy(to, topic_->data, topic_->size);
    seen_ = topic_->generation;
    return topic_->generation != 0;
  }
  bool update(void *to) { return updated() && copy(to); }

 private:
  orb_id_t topic_;
  unsigned seen_ = 0;
};
}  // namespace uORB
