/* Plain C functions around the generated ones. Written by greybox @version@. */
#include "@n@_model.h"

unsigned int @n@_abi(void) { return @up@_ABI; }

@numbers@

static int finite_all(const @n@_real *v, int n) {
  int i;
  if (v == 0) return 1;
  for (i = 0; i < n; ++i) {
    if (!(v[i] - v[i] == 0)) return 0;
  }
  return 1;
}

static int in_range(const @n@_real *x, const @n@_real *u) {
@attitude@
@commands@
  return 1;
}
@seen@@functions@
