#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct vehicle_angular_velocity_s {
  uint64_t timestamp, timestamp_sample;
  float xyz[3], xyz_derivative[3];  // FRD
};
STUB_TOPIC(vehicle_angular_velocity);
