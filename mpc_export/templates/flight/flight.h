/* A pilot in one call a sample: the filter and a linear feedback (@NAME@_eval_pilot_step), with their memory. World
   ENU, body FLU, SI units; columns of y, e and u as in @NAME@_model.h.

   The command that a call returns is in force from the next sample on; what is in force now is flight->u before the call.
   Every command keeps its limits. There is no other limit: no wall, no floor, no largest tilt.

   flight->said are bits, each for what held in FLIGHT_LASTING samples in a row:
   FLIGHT_FAR: the goal was more than @near_position@ m away, or the speed above @near_velocity@ m/s. The feedback
   corrects no more than that at a time: it is on its way to a far goal, or does not hold its place.
   FLIGHT_LIMIT: a command stood at one of its limits: what pushes is more than the rotors hold against.

   A sample that fails is run again without measurements, so that the prediction goes on. A measurement whose innovation is
   more than FLIGHT_GATE of its standard deviations, or a quaternion far from unit length, is as if it were missing. After
   FLIGHT_RESTART samples that failed, or whose pose was that far off, without a good pose between them, the filter starts
   again from the next whole pose. */
#ifndef @UPPER@_FLIGHT_H
#define @UPPER@_FLIGHT_H

#include "@NAME@_model.h"

#ifndef @UPPER@_FLIGHT_GATE
#define @UPPER@_FLIGHT_GATE 1000
#endif
#ifndef @UPPER@_FLIGHT_RESTART
#define @UPPER@_FLIGHT_RESTART 50
#endif

#ifndef @UPPER@_FLIGHT_LASTING
#define @UPPER@_FLIGHT_LASTING @lasting@
#endif
#define @UPPER@_FLIGHT_FAR 1
#define @UPPER@_FLIGHT_LIMIT 2

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  @NAME@_work work;
  @real@ x[@UPPER@_N_X];          /* estimate for the next sample */
  @real@ u[@UPPER@_N_U];          /* command in force until the next sample */
  @real@ p[@UPPER@_N_P + 1];      /* run-time parameters, identified at first */
  @real@ e[@UPPER@_N_E];          /* innovations of the last sample */
  unsigned char used[@UPPER@_N_E]; /* which of them were there and moved the estimate */
  @real@ y_hat[@UPPER@_N_Y];      /* what the last sample was predicted to measure */
  @real@ goal[4];               /* the last that was finite */
  int begun;                    /* whether it knows where it is */
  int code;                     /* return code of the last sample */
  int said;                     /* FLIGHT_FAR and FLIGHT_LIMIT */
  unsigned far, limit;          /* samples in a row of what they say */
  unsigned missed;              /* of the samples since the last good pose: failed, or the pose far off */
  unsigned long failures;       /* samples that came to nothing, since the start */
  unsigned long refused;        /* samples with a measurement that was refused, since the start */
} @NAME@_flight;

/* Forget everything: at rest at place = (x, y, z [m], heading [rad]). Returns 0 for a place that is not finite: then the
   command is that of hover until a whole finite pose is measured, and the filter starts there. */
int @NAME@_flight_start(@NAME@_flight *flight, const @real@ place[4]);

/* A run-time parameter, such as a voltage; a value that is not finite and positive is ignored. */
void @NAME@_flight_parameter(@NAME@_flight *flight, int i, @real@ value);

/* One sample: measurements y, whether each is there, goal = (x, y, z [m], heading [rad]), the last
   one where it is not finite. Returns the model's code. */
int @NAME@_flight_sample(@NAME@_flight *flight, const @real@ y[@UPPER@_N_Y], const unsigned char there[@UPPER@_N_Y],
                         const @real@ goal[4]);

/* The same where somebody else flies: u is the command in force until the next sample. */
int @NAME@_flight_watch(@NAME@_flight *flight, const @real@ y[@UPPER@_N_Y], const unsigned char there[@UPPER@_N_Y],
                        const @real@ u[@UPPER@_N_U]);

/* What will be measured so many samples from now, if the command stays. Returns the model's code. */
int @NAME@_flight_ahead(@NAME@_flight *flight, int samples, @real@ y[@UPPER@_N_Y]);

#ifdef __cplusplus
}
#endif

#endif
