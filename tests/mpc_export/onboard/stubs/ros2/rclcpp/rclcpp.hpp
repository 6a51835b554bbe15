// What a node sees of rclcpp, written from its published interface. spin() is the bench: every row of the standard input is
// position, quaternion w x y z, twist in body axes, rates, force, goal x y z and heading, whether pose and imu are new (imu
// 2: without force), whether the goal is given, and commands of others; it prints what is published, predictions first.
#pragma once
#include <any>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include <geometry_msgs/msg/pose_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <sensor_msgs/msg/imu.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

namespace rclcpp {
struct QoS {
  QoS(int) {}
};
struct SensorDataQoS : QoS {
  SensorDataQoS() : QoS(5) {}
};
template <class M>
struct Subscription {
  using SharedPtr = std::shared_ptr<Subscription>;
};
struct TimerBase {
  using SharedPtr = std::shared_ptr<TimerBase>;
};
inline std::map<std::string, std::any> listeners;
inline std::map<std::string, std::vector<double>> published;
inline std::function<void()> timer;
inline bool fly = false;

template <class M>
struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  std::string topic;
  void publish(const M &m) { published[topic] = m.data; }
};
class Node {
 public:
  explicit Node(const std::string &) {}
  virtual ~Node() = default;
  template <class T>
  T declare_parameter(const std::string &name, const T &value) { return name == "fly" ? static_cast<T>(fly) : value; }
  template <class M, class F>
  typename Subscription<M>::SharedPtr create_subscription(const std::string &topic, const QoS &, F &&call) {
    listeners[topic] = std::function<void(typename M::ConstSharedPtr)>(call);
    return std::make_shared<Subscription<M>>();
  }
  template <class M>
  typename Publisher<M>::SharedPtr create_publisher(const std::string &topic, const QoS &) {
    return std::make_shared<Publisher<M>>(Publisher<M>{topic});
  }
  template <class D, class F>
  TimerBase::SharedPtr create_wall_timer(D, F &&call) {
    timer = call;
    return std::make_shared<TimerBase>();
  }
};
inline void init(int argc, char **) { fly = argc > 1; }
inline void shutdown() {}
template <class M>
void tell(const std::string &topic, const M &m) {
  std::any_cast<std::function<void(typename M::ConstSharedPtr)>>(listeners.at(topic))(std::make_shared<const M>(m));
}
inline void spin(std::shared_ptr<Node>) {
  double v[27];
  int n = 0;
  while (std::scanf("%lf", &v[n]) == 1) {
    if (++n < 27) continue;
    n = 0;
    if (v[20] != 0) {
      nav_msgs::msg::Odometry m;
      m.pose.pose.position = {v[0], v[1], v[2]};
      m.pose.pose.orientation = {v[4], v[5], v[6], v[3]};
      m.twist.twist.linear = {v[7], v[8], v[9]};
      tell("odometry", m);
    }
    if (v[21] != 0) {
      sensor_msgs::msg::Imu m;
      m.angular_velocity = {v[10], v[11], v[12]};
      m.linear_acceleration = {v[13], v[14], v[15]};
      if (v[21] == 2) m.linear_acceleration_covariance[0] = -1;
      tell("imu", m);
    }
    if (v[22] != 0) {
      geometry_msgs::msg::PoseStamped m;
      m.pose.position = {v[16], v[17], v[18]};
      m.pose.orientation = {0, 0, std::sin(v[19] / 2), std::cos(v[19] / 2)};
      tell("goal", m);
    }
    std_msgs::msg::Float64MultiArray given;
    given.data.assign(v + 23, v + 27);
    tell("commands_given", given);
    published.clear();
    timer();
    std::printf("0");
    for (const char *topic : {"commands", "predicted"}) {
      for (double value : published[topic]) std::printf(" %.17g", value);
    }
    std::printf("\n");
  }
}
}  // namespace rclcpp
