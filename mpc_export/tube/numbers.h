/* What every part asks of numbers. */

/* Before a loop over a few dozen numbers: a third of its instructions count them. */
#if defined(__GNUC__) && !defined(__clang__)
#define UNROLLED _Pragma("GCC unroll 8")
#else
#define UNROLLED
#endif

/* The larger of two sizes; infinite where one is no number, so that a NaN is never lost among numbers. */
static tube_real larger(tube_real a, tube_real b) {
  if (isnan(a) || isnan(b)) return (tube_real)INFINITY;
  return a > b ? a : b;
}

static tube_real largest(const tube_real *v, int n) {
  tube_real m = 0;
  for (int i = 0; i < n; i++) m = larger(m, fabs(v[i]));
  return m;
}

static tube_real clip(tube_real v, tube_real low, tube_real high) { return v < low ? low : (v > high ? high : v); }
