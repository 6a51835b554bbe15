#pragma once
#include <memory>
#include <vector>
namespace std_msgs::msg {
struct Float64MultiArray {
  using ConstSharedPtr = std::shared_ptr<const Float64MultiArray>;
  std::vector<double> data;
};
}  // namespace std_msgs::msg
