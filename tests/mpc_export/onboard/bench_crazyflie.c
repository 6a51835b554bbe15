/* Rows of the firmware's numbers through an app: position, velocity, quaternion x y z w, gyro [deg/s], acc [g], setpoint x y
   z [m] and yaw [deg], its mode, the yaw that is [deg], modes of yaw and quaternion, heading
   of the quaternion [deg]. Every row is a sample of CALLS calls; prints the forces of the last call and predictions. */
#include <math.h>
#include <stdio.h>

#include "controller.h"
#include "log.h"
#include "app.h"
#include "pm.h"
#include "task.h"

void vTaskDelay(unsigned int ticks) { (void)ticks; }
float pmGetBatteryVoltage(void) { return 3.7f; }
extern const struct log_s logs_craft[];

int main(void) {
  static control_t control;
  static setpoint_t setpoint;
  static sensorData_t sensors;
  static state_t state;
  float v[25];
  unsigned int step = 0;
  int n = 0, i;
  controllerOutOfTreeInit();
  if (!controllerOutOfTreeTest()) return 1;
  while (scanf("%f", &v[n]) == 1) {
    if (++n < 25) continue;
    n = 0;
    state.position = (point_t){.x = v[0], .y = v[1], .z = v[2]};
    state.velocity = (velocity_t){.x = v[3], .y = v[4], .z = v[5]};
    state.attitudeQuaternion = (quaternion_t){.x = v[6], .y = v[7], .z = v[8], .w = v[9]};
    state.attitude.yaw = v[21];
    sensors.gyro = (Axis3f){v[10], v[11], v[12]};
    sensors.acc = (Axis3f){v[13], v[14], v[15]};
    setpoint.position = (point_t){.x = v[16], .y = v[17], .z = v[18]};
    setpoint.attitude.yaw = v[19];
    setpoint.mode.x = setpoint.mode.y = setpoint.mode.z = (stab_mode_t)(int)v[20];
    setpoint.mode.yaw = (stab_mode_t)(int)v[22];
    setpoint.mode.quat = (stab_mode_t)(int)v[23];
    setpoint.attitudeQuaternion =
        (quaternion_t){.z = sinf(v[24] * 0.00872664626f), .w = cosf(v[24] * 0.00872664626f)};
    for (i = 0; i < CALLS; ++i) controllerOutOfTree(&control, &setpoint, &sensors, &state, step++);
    printf("%d", control.controlMode == controlModeForce);
    for (i = 0; i < 4; ++i) printf(" %.9g", (double)control.normalizedForces[i]);
    for (i = 0; logs_craft[i].name; ++i) {
      if (logs_craft[i].type == LOG_FLOAT) printf(" %.9g", (double)*(const float *)logs_craft[i].address);
    }
    printf("\n");
  }
  return n != 0;
}
