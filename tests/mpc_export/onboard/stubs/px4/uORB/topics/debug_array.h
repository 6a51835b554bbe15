#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct debug_array_s {
  static constexpr uint8_t ARRAY_SIZE = 58;
  uint64_t timestamp;
  float data[58];
  uint16_t id;
  char name[10];
};
STUB_TOPIC(debug_array);
