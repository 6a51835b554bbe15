/* What an app sees of crazyflie-firmware, written from its published interface. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

typedef struct {
  float x, y, z;
} Axis3f;
typedef struct {
  uint32_t timestamp;
  float x, y, z;
} point_t, velocity_t, acc_t;
typedef struct {
  uint32_t timestamp;
  float roll, pitch, yaw; /* deg */
} attitude_t;
typedef struct {
  uint32_t timestamp;
  float x, y, z, w;
} quaternion_t;
typedef struct {
  Axis3f acc;  /* g */
  Axis3f gyro; /* deg/s */
  Axis3f mag;
  uint64_t interruptTimestamp;
} sensorData_t;
typedef struct {
  attitude_t attitude; /* deg, pitch inverted */
  quaternion_t attitudeQuaternion;
  point_t position;
  velocity_t velocity;
  acc_t acc;
} state_t;
typedef enum { controlModeLegacy = 0, controlModeForceTorque = 1, controlModeForce = 2 } control_mode_t;
typedef struct {
  union {
    struct {
      int16_t roll, pitch, yaw;
      float thrust;
    };
    float normalizedForces[4]; /* 0 to 1 */
  };
  control_mode_t controlMode;
} control_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  uint32_t timestamp;
  attitude_t attitude, attitudeRate;
  quaternion_t attitudeQuaternion;
  float thrust;
  point_t position;
  velocity_t velocity;
  acc_t acceleration;
  bool velocity_body;
  struct {
    stab_mode_t x, y, z, roll, pitch, yaw, quat;
  } mode;
} setpoint_t;
typedef uint32_t stabilizerStep_t;
