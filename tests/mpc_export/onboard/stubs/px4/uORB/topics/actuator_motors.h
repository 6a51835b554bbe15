#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct actuator_motors_s {
  static constexpr uint8_t NUM_CONTROLS = 12;
  uint64_t timestamp, timestamp_sample;
  uint16_t reversible_flags;
  float control[12];
};
STUB_TOPIC(actuator_motors);
