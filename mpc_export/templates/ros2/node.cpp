// @NAME@: filter, prediction and pilot of the bundle in ../../c as a ROS 2 node.
#include <chrono>
#include <cmath>
#include <memory>

#include <geometry_msgs/msg/pose_stamped.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rclcpp/rclcpp.hpp>
@battery_header@#include <sensor_msgs/msg/imu.hpp>
#include <std_msgs/msg/float64_multi_array.hpp>

#include "../../c/@NAME@_flight.h"

class @Class@ : public rclcpp::Node {
 public:
  @Class@() : Node("@NAME@") {
    fly_ = declare_parameter<bool>("fly", false);
    carried_ = declare_parameter<double>("carried", 0.5);
    const @real@ origin[4] = {};
    @NAME@_flight_start(&flight_, origin);
    // until somebody says what the command is, it is that of hover
    for (int i = 0; i < @UPPER@_N_U; ++i) others_[i] = flight_.u[i];
    const auto sensors = rclcpp::SensorDataQoS();
    odometry_ = create_subscription<nav_msgs::msg::Odometry>(
        "odometry", sensors, [this](nav_msgs::msg::Odometry::ConstSharedPtr m) { place(*m); });
    imu_ = create_subscription<sensor_msgs::msg::Imu>(
        "imu", sensors, [this](sensor_msgs::msg::Imu::ConstSharedPtr m) { turning(*m); });
    goal_ = create_subscription<geometry_msgs::msg::PoseStamped>(
        "goal", 1, [this](geometry_msgs::msg::PoseStamped::ConstSharedPtr m) { aim(*m); });
    given_ = create_subscription<std_msgs::msg::Float64MultiArray>(
        "commands_given", sensors, [this](std_msgs::msg::Float64MultiArray::ConstSharedPtr m) { given(*m); });
@battery_subscription@    commands_ = create_publisher<std_msgs::msg::Float64MultiArray>("commands", 1);
    predicted_ = create_publisher<std_msgs::msg::Float64MultiArray>("predicted", 1);
    said_ = create_publisher<std_msgs::msg::Float64MultiArray>("said", 1);
    timer_ = create_wall_timer(std::chrono::nanoseconds(@nanos@), [this] { sample(); });
  }

 private:
  void place(const nav_msgs::msg::Odometry &m) {
    const auto &at = m.pose.pose.position;
    const auto &q = m.pose.pose.orientation;
    const auto &v = m.twist.twist.linear;
    place_[0] = at.x, place_[1] = at.y, place_[2] = at.z;
    q_[0] = q.w, q_[1] = q.x, q_[2] = q.y, q_[3] = q.z;
    // the twist is in body axes, the model's velocity in the world's: v + 2 w (r x v) + 2 r x (r x v)
    const double t[3] = {2 * (q.y * v.z - q.z * v.y), 2 * (q.z * v.x - q.x * v.z), 2 * (q.x * v.y - q.y * v.x)};
    speed_[0] = v.x + q.w * t[0] + q.y * t[2] - q.z * t[1];
    speed_[1] = v.y + q.w * t[1] + q.z * t[0] - q.x * t[2];
    speed_[2] = v.z + q.w * t[2] + q.x * t[1] - q.y * t[0];
    seen_place_ = true;
    blind_ = 0;
  }

  void turning(const sensor_msgs::msg::Imu &m) {
    rate_[0] = m.angular_velocity.x, rate_[1] = m.angular_velocity.y, rate_[2] = m.angular_velocity.z;
    force_[0] = m.linear_acceleration.x, force_[1] = m.linear_acceleration.y, force_[2] = m.linear_acceleration.z;
    // a covariance that begins with -1 says that there is no such measurement
    seen_rate_ = m.angular_velocity_covariance[0] != -1;
    seen_force_ = m.linear_acceleration_covariance[0] != -1;
  }

  void aim(const geometry_msgs::msg::PoseStamped &m) {
    const auto &q = m.pose.orientation;
    aim_[0] = static_cast<@real@>(m.pose.position.x), aim_[1] = static_cast<@real@>(m.pose.position.y);
    aim_[2] = static_cast<@real@>(m.pose.position.z);
    aim_[3] = static_cast<@real@>(std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z)));
    aimed_ = true;
  }

  void given(const std_msgs::msg::Float64MultiArray &m) {
    if (m.data.size() != @UPPER@_N_U) return;
    for (int i = 0; i < @UPPER@_N_U; ++i) others_[i] = static_cast<@real@>(m.data[i]);
  }

  void sample() {
    @real@ y[@UPPER@_N_Y] = {};
    unsigned char there[@UPPER@_N_Y] = {};
@measured@
    if (!begun_) {
      if (!seen_place_) return;
      const double w = q_[0], x = q_[1], yy = q_[2], z = q_[3];
      const double heading = std::atan2(2 * (w * z + x * yy), 1 - 2 * (yy * yy + z * z));
      const @real@ at[4] = {static_cast<@real@>(place_[0]), static_cast<@real@>(place_[1]), static_cast<@real@>(place_[2]),
                         static_cast<@real@>(heading)};
      begun_ = @NAME@_flight_start(&flight_, at) != 0;
      if (!begun_) return;
    }
@battery@    seen_place_ = seen_rate_ = seen_force_ = false;
    const bool lost = blind_++ * @dt@ > carried_;
    if (fly_ && aimed_) {
      // where nobody knows where it is, it stops until there are odometry and a new goal
      stopped_ = lost;
      aimed_ = !lost;
    }
    if (fly_ && aimed_) {
      // what the sample before decided comes into force now
      command(flight_.u);
      @NAME@_flight_sample(&flight_, y, there, aim_);
    } else if (stopped_) {
      const @real@ lowest[@UPPER@_N_U] = {@stopped@};
      command(lowest);
      @NAME@_flight_watch(&flight_, y, there, lowest);
    } else {
      @NAME@_flight_watch(&flight_, y, there, others_);
    }
    std_msgs::msg::Float64MultiArray predicted;
    predicted.data.assign(flight_.y_hat, flight_.y_hat + @UPPER@_N_Y);
    predicted_->publish(predicted);
    std_msgs::msg::Float64MultiArray said;
    said.data = {static_cast<double>(flight_.code), static_cast<double>(flight_.said)};
    said_->publish(said);
  }

  void command(const @real@ *u) {
    std_msgs::msg::Float64MultiArray commands;
    commands.data.assign(u, u + @UPPER@_N_U);
    commands_->publish(commands);
  }

  rclcpp::Subscription<nav_msgs::msg::Odometry>::SharedPtr odometry_;
  rclcpp::Subscription<sensor_msgs::msg::Imu>::SharedPtr imu_;
  rclcpp::Subscription<geometry_msgs::msg::PoseStamped>::SharedPtr goal_;
  rclcpp::Subscription<std_msgs::msg::Float64MultiArray>::SharedPtr given_;
@battery_member@  rclcpp::Publisher<std_msgs::msg::Float64MultiArray>::SharedPtr commands_, predicted_, said_;
  rclcpp::TimerBase::SharedPtr timer_;
  double place_[3] = {}, speed_[3] = {}, q_[4] = {1, 0, 0, 0}, rate_[3] = {}, force_[3] = {};
  @real@ aim_[4] = {}, others_[@UPPER@_N_U] = {};
  @NAME@_flight flight_ = {};
  double carried_ = 0.5;     // [s] that it flies without odometry
  unsigned long blind_ = 0;  // samples since odometry came
  bool fly_ = false, aimed_ = false, stopped_ = false, begun_ = false;
  bool seen_place_ = false, seen_rate_ = false, seen_force_ = false;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<@Class@>());
  rclcpp::shutdown();
  return 0;
}
