#pragma once
#include <array>
#include <memory>
#include "../../geometry_msgs/msg/pose_stamped.hpp"
namespace sensor_msgs::msg {
struct Imu {
  using ConstSharedPtr = std::shared_ptr<const Imu>;
  geometry_msgs::msg::Vector3 angular_velocity, linear_acceleration;
  std::array<double, 9> angular_velocity_covariance{}, linear_acceleration_covariance{};
};
}  // namespace sensor_msgs::msg
