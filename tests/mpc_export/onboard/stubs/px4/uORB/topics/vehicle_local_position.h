#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct vehicle_local_position_s {
  uint64_t timestamp, timestamp_sample;
  bool xy_valid, z_valid, v_xy_valid, v_z_valid;
  float x, y, z, vx, vy, vz;  // NED
  float heading;
};
STUB_TOPIC(vehicle_local_position);
