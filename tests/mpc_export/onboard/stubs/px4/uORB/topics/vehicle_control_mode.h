#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct vehicle_control_mode_s {
  uint64_t timestamp;
  bool flag_armed, flag_control_offboard_enabled, flag_control_allocation_enabled;
};
STUB_TOPIC(vehicle_control_mode);
