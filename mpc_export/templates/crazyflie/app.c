/* @NAME@ as the controller "out of tree" of a Crazyflie. Every @calls@ calls (@dt@ s) one sample of the pilot in ../../c;
   the command of a sample is in force from the next one on, as in the model. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller.h"
#include "log.h"
@battery_header@#include "stabilizer_types.h"
#include "task.h"

#include "../../c/@NAME@_flight.h"

#if @UPPER@_N_U != 4
#error "a Crazyflie has four motors"
#endif

/* How four numbers from 0 to 1 become motor ratios. On firmware that maps forces to ratios by a curve take
   -D@UPPER@_CONTROL_MODE=controlModePwm: the model's commands are ratios. */
#ifndef @UPPER@_CONTROL_MODE
#define @UPPER@_CONTROL_MODE controlModeForce
#endif

static @NAME@_flight flight;
static bool flying;
static @real@ heading;  /* to hold [rad] */
static uint8_t said;
static float ratio[4], predicted[@UPPER@_N_Y];

void appMain(void) {
  while (1) {
    vTaskDelay(M2T(2000));
  }
}

void controllerOutOfTreeInit(void) {
  const @real@ place[4] = {0};
  @NAME@_flight_start(&flight, place);
  flying = false;
}

bool controllerOutOfTreeTest(void) {
  return @NAME@_abi() == @UPPER@_ABI;
}

/* Columns of the model from the firmware's units: degrees, g, metres. */
static void measured(const sensorData_t *sensors, const state_t *state, @real@ *y, unsigned char *there) {
  memset(y, 0, @UPPER@_N_Y * sizeof *y);
  memset(there, 0, @UPPER@_N_Y);
  (void)sensors;
  (void)state;
@measured@
}

/* The heading that a setpoint wants; what says none keeps the last one. */
static void aim(const setpoint_t *setpoint) {
  if (setpoint->mode.quat == modeAbs) {
    const quaternion_t *q = &setpoint->attitudeQuaternion;
    heading = @atan2@(2 * (q->w * q->z + q->x * q->y), 1 - 2 * (q->y * q->y + q->z * q->z));
  } else if (setpoint->mode.yaw == modeAbs) {
    heading = setpoint->attitude.yaw * @degree@;
  }
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t step) {
  int i;
  if (step % @calls@ == 0) {
    @real@ y[@UPPER@_N_Y];
    unsigned char there[@UPPER@_N_Y];
    const bool wanted = setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
    if (wanted && !flying) {
      const @real@ place[4] = {state->position.x, state->position.y, state->position.z, state->attitude.yaw * @degree@};
      @NAME@_flight_start(&flight, place);
      heading = place[3];
    }
    flying = wanted;
    if (flying) {
      @real@ goal[4] = {setpoint->position.x, setpoint->position.y, setpoint->position.z, 0};
      aim(setpoint);
      goal[3] = heading;
      for (i = 0; i < 4; ++i) ratio[i] = (float)flight.u[i];
      measured(sensors, state, y, there);
@battery@      @NAME@_flight_sample(&flight, y, there, goal);
      said = (uint8_t)flight.said;
      for (i = 0; i < @UPPER@_N_Y; ++i) predicted[i] = (float)flight.y_hat[i];
    }
  }
  control->controlMode = @UPPER@_CONTROL_MODE;
  for (i = 0; i < 4; ++i) control->normalizedForces[i] = flying ? ratio[i] : 0.0f;
}

/* Predictions, to be logged beside what was measured. */
LOG_GROUP_START(@log@)
@logged@
LOG_ADD(LOG_UINT8, said, &said)
LOG_GROUP_STOP(@log@)
