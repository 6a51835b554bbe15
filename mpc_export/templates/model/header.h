/* @n@: @what@, @dt@ s a sample. Written by greybox @version@; see README.md.

   Frames: world ENU (z up), body FLU (x forward, y left, z up); the unit quaternion (w, x, y, z) maps body
   vectors to world; SI units. Matrices are stored column by column. Error states: README.md.

   Reentrant and free of state: any number of threads may call any function at once, each with its own work.
   No malloc, no stdio. Do not compile with -ffast-math: it would remove the checks for NaN. */
#ifndef @up@_MODEL_H
#define @up@_MODEL_H

#include "@n@.h"

#define @up@_GREYBOX_VERSION "@version@"
#define @up@_ABI 0x@abi@u  /* changes with the layout of any argument or result */
#if defined(@up@_EXPECTED_ABI) && @up@_EXPECTED_ABI != @up@_ABI
#error "@n@: another layout than the program was written for"
#endif

#define @up@_SAMPLE_TIME @dt_number@  /* [s] */
#define @up@_N_OWN_STATES @own_states@  /* of x; f and f_jac_raw take these alone, the rest is history */
@tables@

/* return codes */
@codes@

/* work space of any one call, owned by the caller */
@work@
typedef struct {
  const @n@_real *arg[@up@_SZ_ARG + 1];
  @n@_real *res[@up@_SZ_RES + 1];
  @n@_int iw[@up@_SZ_IW + 1];
  @n@_real w[@up@_SZ_W + 1];
} @n@_work;

#ifdef __cplusplus
extern "C" {
#endif

/* @up@_ABI of the compiled library */
unsigned int @n@_abi(void);

@numbers@

/* A null pointer for a result: it is not wanted. For p where the model has none: 0. Results must not overlap
   arguments: x_next is another array than x. */
@functions@

#ifdef __cplusplus
}
#endif

#endif /* @up@_MODEL_H */
