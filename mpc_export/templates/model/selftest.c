/* Self-test of @n@: every function at golden points. Returns 0 when all agree. Written by greybox
   @version@. */
#include <stdio.h>
#include "@n@_model.h"

static @n@_work work;
static @n@_real result[@most@];
static double worst;
static int failures;

static double compare(const @n@_real *got, const double *want, int n, double scale) {
  double most = 0;
  int i;
  for (i = 0; i < n; ++i) {
    double gap = (double)got[i] - want[i];
    if (gap < 0) gap = -gap;
    if (!(gap == gap)) return 1e300;
    if (gap > most) most = gap;
  }
  return most / scale;
}

static void judge(const char *name, int code, double gap) {
  if (gap > worst) worst = gap;
  if (code > @up@_OUT_OF_RANGE || gap > @limit@) {
    ++failures;
    printf("%s: code %d, difference %.2g of the output's scale\n", name, code, gap);
  }
}
@tests@
int main(void) {
  if (@n@_abi() != @up@_ABI) {
    printf("the library has another layout than the header\n");
    return 2;
  }
@calls@
  printf("@n@: %d functions, largest difference %.2g of the output's scale (limit @limit@): %s\n",
         @count@, worst, failures ? "FAILED" : "passed");
  return failures ? 1 : 0;
}
