#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct vehicle_attitude_s {
  uint64_t timestamp, timestamp_sample;
  float q[4];  // w x y z, FRD to NED
  float delta_q_reset[4];
  uint8_t quat_reset_counter;
};
STUB_TOPIC(vehicle_attitude);
