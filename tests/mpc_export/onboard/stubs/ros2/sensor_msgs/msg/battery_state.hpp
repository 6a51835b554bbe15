#pragma once
#include <memory>

namespace sensor_msgs::msg {
struct BatteryState {
  using ConstSharedPtr = std::shared_ptr<const BatteryState>;
  float voltage = 0;
};
}  // namespace sensor_msgs::msg
