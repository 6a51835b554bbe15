/* @NAME@: the tube MPC in one call a sample. World ENU, body FLU, SI units.

   Columns of y: @outputs@.
   Commands u: @inputs@, from @low@ to @high@, no more than @rate@ apart from plan to plan.
   A sample is @sample@ s, a plan is made every @every@ samples, for @horizon@ stages of @dt@ s.

   A command that a call returns is in force from the next sample on. Whatever is measured, every command keeps its limits
   and its rate. Nothing is allocated; memory is static, so that an image has one controller, called from one place. */
#ifndef @UPPER@_TUBE_H
#define @UPPER@_TUBE_H

#ifdef __cplusplus
extern "C" {
#endif

typedef @real@ @NAME@_tube_real;

enum {
  @UPPER@_TUBE_N_Y = @n_y@,
  @UPPER@_TUBE_N_U = @n_u@,
  @UPPER@_TUBE_STAGES = @horizon@,
  @UPPER@_TUBE_PLANES = @planes@,
  @UPPER@_TUBE_N_P = @n_p@ /* run-time parameters: @told@ */
};

/* What a call says, bits: it went as usual where it says 0. */
enum {
  @UPPER@_TUBE_NOT_STARTED = 1,       /* there was no start: hover's command */
  @UPPER@_TUBE_NO_MEASUREMENT = 2,    /* the filter predicts */
  @UPPER@_TUBE_DOUBTED = 4,           /* a measurement counts in part: 8 standard deviations off */
  @UPPER@_TUBE_NOT_BELIEVED = 8,      /* a measurement does not count */
  @UPPER@_TUBE_FILTER_FAILED = 16,    /* its estimate was not finite, and is not taken over */
  @UPPER@_TUBE_FILTER_ANEW = 32,      /* an estimate begun at what is measured takes over */
  @UPPER@_TUBE_CALLS_MISSED = 64,     /* the filter predicts over the gap */
  @UPPER@_TUBE_CLOCK = 128,           /* `passed` is no time: one sample has passed */
  @UPPER@_TUBE_NO_SOLUTION = 256,     /* the plan before and the ancillary gain, or the gain about the path */
  @UPPER@_TUBE_NOT_BEST = 512,        /* a plan within its limits whose QP was cut off */
  @UPPER@_TUBE_CLIPPED = 1024,        /* commands of the plan were moved by their limits */
  @UPPER@_TUBE_BEYOND_LIMITS = 2048,  /* a command was not finite, or moved by its limits */
  @UPPER@_TUBE_WEAK = 4096,           /* no steady command within the limits holds the place: come down */
  @UPPER@_TUBE_BLIND = 8192,          /* no pose for longer than the filter may carry on: come down */
  @UPPER@_TUBE_FAR_FROM_HOVER = 16384, /* the linear tube: so tilted or fast that its plan is not to be trusted */
  @UPPER@_TUBE_NOT_TOLD = 32768,      /* a run-time parameter is not known: it follows the push along the thrust */
  @UPPER@_TUBE_REFUSED = 65536,       /* a told parameter at which the model cannot hover: the one before stays */
  @UPPER@_TUBE_UNTRAINED = 131072,    /* a parameter is used beyond its training range */
  @UPPER@_TUBE_SLACK = 262144,        /* the plan does not hold a plane or the tilt, by more than @slack@ */
  @UPPER@_TUBE_HEAVY = 524288         /* pushed down by a third of the weight: a load, or thrust is lost */
};

/* The reference at one time [s, m, rad]. */
typedef struct {
  @NAME@_tube_real position[3], velocity[3], acceleration[3], yaw;
} @NAME@_tube_path;

/* What is known after a call. */
typedef struct {
  @NAME@_tube_real estimate[@n_x@]; /* for the next sample: @states@ */
  @NAME@_tube_real seconds_since_pose;
  /* status of the last plan: -1 there was none yet, 0 found, 1 a function of the model is not finite, 2 the QP, 3 Newton's
     steps grow. From 1 on the command is a safe one, and NO_SOLUTION is said. */
  int qp_iterations, plan_status;
} @NAME@_tube_known;

/* Forget everything: at rest at place = (x, y, z, heading). Returns 0, and does nothing, for a place that is not finite. */
int @NAME@_tube_start(const @NAME@_tube_real place[4]);

/* Standard deviations by which planes, the tilt (last) and the commands are tightened, from now to the
   next start, which sets @kappa@ and @kappa_u@. */
void @NAME@_tube_kappa(const @NAME@_tube_real kappa[@UPPER@_TUBE_PLANES + 1], @NAME@_tube_real commands);

/* The present value of run-time parameter i, of N_P, from the next step on; after a start, which forgets it. A value counts
   as present for @present@ s. NaN: not known any more. See the bits. */
void @NAME@_tube_parameter(int i, @NAME@_tube_real value);

/* The command from the next sample on, given what is measured now. passed: time since the call before [s]. given: which y
   are measured. path: the reference one sample from now, and stage by stage from there. planes: (STAGES + 1, PLANES, 4),
   normal and offset per stage, position . normal <= offset; null: none. */
unsigned @NAME@_tube_step(@NAME@_tube_real passed, const @NAME@_tube_real y[@UPPER@_TUBE_N_Y],
                          const unsigned char given[@UPPER@_TUBE_N_Y],
                          const @NAME@_tube_path path[@UPPER@_TUBE_STAGES + 1],
                          const @NAME@_tube_real *planes,
                          @NAME@_tube_real u[@UPPER@_TUBE_N_U]);

const @NAME@_tube_known *@NAME@_tube_state(void);

#ifdef __cplusplus
}
#endif

#endif
