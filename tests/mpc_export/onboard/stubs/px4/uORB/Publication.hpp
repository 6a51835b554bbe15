#pragma once
#include "Subscription.hpp"
namespace uORB {
template <class T>
class Publication {
 public:
  explicit Publication(orb_id_t topic) : topic_(topic) {}
  bool publish(const T &data) {
    std::memcpy(topic_->data, &data, sizeof data);
    ++topic_->generation;
    return true;
  }

 private:
  orb_id_t topic_;
};
}  // namespace uORB
