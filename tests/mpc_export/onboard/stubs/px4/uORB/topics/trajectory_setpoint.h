#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct trajectory_setpoint_s {
  uint64_t timestamp;
  float position[3], velocity[3], acceleration[3], jerk[3];  // NED
  float yaw, yawspeed;
};
STUB_TOPIC(trajectory_setpoint);
