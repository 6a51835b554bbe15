#pragma once
#include <cstdint>
#include "../Subscription.hpp"
struct sensor_combined_s {
  static constexpr int32_t RELATIVE_TIMESTAMP_INVALID = 2147483647;
  uint64_t timestamp;
  float gyro_rad[3];  // FRD
  uint32_t gyro_integral_dt;
  int32_t accelerometer_timestamp_relative;
  float accelerometer_m_s2[3];  // FRD
  uint32_t accelerometer_integral_dt;
};
STUB_TOPIC(sensor_combined);
