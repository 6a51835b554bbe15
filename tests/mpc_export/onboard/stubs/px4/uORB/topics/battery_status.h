#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct battery_status_s {
  uint64_t timestamp;
  float voltage_v;
};
STUB_TOPIC(battery_status);
