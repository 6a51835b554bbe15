#pragma once
#include <memory>

namespace geometry_msgs::msg {
struct Vector3 {
  double x = 0, y = 0, z = 0;
};
struct Quaternion {
  double x = 0, y = 0, z = 0, w = 1;
};
struct Pose {
  Vector3 position;
  Quaternion orientation;
};
struct PoseStamped {
  using ConstSharedPtr = std::shared_ptr<const PoseStamped>;
  Pose pose;
};
}  // namespace geometry_msgs::msg
