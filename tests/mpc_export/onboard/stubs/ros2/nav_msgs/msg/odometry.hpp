#pragma once
#include <memory>
#include "../../geometry_msgs/msg/pose_stamped.hpp"
namespace nav_msgs::msg {
struct Odometry {
  using ConstSharedPtr = std::shared_ptr<const Odometry>;
  struct {
    geometry_msgs::msg::Pose pose;
  } pose;
  struct {
    struct {
      geometry_msgs::msg::Vector3 linear, angular;
    } twist;
  } twist;  // in body axes
};
}  // namespace nav_msgs::msg
