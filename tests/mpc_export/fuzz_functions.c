/* Fuzz of exported functions: arguments of every kind, whole or in part, missing ones, results that are not wanted.

       fuzz STEPS SEED

   Stands behind a table FUNCTIONS of COUNT entries (test_no_argument_breaks_the_c_of_an_export.py writes it). Every
   call is made twice with other rubbish in the work space: what comes out may depend on the arguments alone, and must be
   finite where these are those of a flight. Buffers are of the exact sizes that the bundle declares, for the sanitizers'
   sake. Prints "kind calls finite not-finite refused" per kind; exit code 1 where a rule is broken. Hangs are for whoever
   starts it. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { NOMINAL, NEAR, WILD, NOT_A_NUMBER, INFINITE, ZERO, DENORMAL, HUGE_NUMBER, WHOLE, MIXED, KINDS };
static const char *const NAMES[KINDS] = {"nominal", "near", "wild", "nan", "inf", "zero", "denormal", "huge", "whole", "mixed"};

static real damaged(real v, int kind) {
  const int single = sizeof(real) == sizeof(float);
  switch (kind) {
    case NEAR: return v + (real)(0.3 * (uniform() - 0.5));
    case WILD: return v + (real)signed_power(-3, 12);
    case NOT_A_NUMBER: return (real)NAN;
    case INFINITE: return (real)(uniform() < 0.5 ? INFINITY : -INFINITY);
    case ZERO: return (real)(uniform() < 0.5 ? 0.0 : -0.0);
    case DENORMAL: return (real)(single ? signed_power(-44, -38) : signed_power(-323, -308));
    case HUGE_NUMBER: return (real)(single ? signed_power(12, 38) : signed_power(100, 308));
    case WHOLE: return (real)((drawn(19) - 9) * pow(10.0, drawn(30)));
    case MIXED: return damaged(v, 1 + drawn(MIXED - 1));
    default: return v;
  }
}

static void *room(size_t count, size_t size) {
  void *p = malloc(count ? count * size : 1);
  if (p == NULL) exit(2);
  return p;
}

/* One call on work space full of `rubbish`, results into out. */
static int called(const function *f, const real *const *given, real *const *out, unsigned char rubbish) {
  const real **arg = room((size_t)f->sz_arg, sizeof *arg);
  real **res = room((size_t)f->sz_res, sizeof *res), *w = room((size_t)f->sz_w, sizeof *w);
  integer *iw = room((size_t)f->sz_iw, sizeof *iw);
  memset(w, rubbish, (size_t)f->sz_w * sizeof *w);
  memset(iw, rubbish, (size_t)f->sz_iw * sizeof *iw);
  for (int i = 0; i < f->sz_arg; i++) arg[i] = i < f->n_arg ? given[i] : NULL;
  for (int i = 0; i < f->sz_res; i++) res[i] = i < f->n_res ? out[i] : NULL;
  int code = f->call(arg, res, iw, w, 0);
  free(arg), free(res), free(w), free(iw);
  return code;
}

int main(int argc, char **argv) {
  long counts[KINDS][4] = {{0}}, broken = 0;
  if (argc != 3) return 2;
  long steps = atol(argv[1]);
  state_of_rng = UINT64_C(88172645463325252) + (uint64_t)atol(argv[2]) * UINT64_C(2654435761);
  for (long step = 0; step < steps; step++) {
    const function *f = &FUNCTIONS[step % COUNT];
    static const double SHARES[] = {0.02, 0.2, 1.0};
    int kind = drawn(KINDS), missing = kind != NOMINAL && uniform() < 0.02 ? drawn(f->n_arg + 1) : -1;
    int unwanted = uniform() < 0.05 ? drawn(f->n_res + 1) : -1;
    double share = SHARES[drawn(3)];
    const real *given[32];
    real *out[2][32];
    const real *from = f->nominal;
    for (int i = 0; i < f->n_arg; i++) {
      real *v = room((size_t)f->arg[i], sizeof *v);
      for (int j = 0; j < f->arg[i]; j++, from++) v[j] = uniform() < share ? damaged(*from, kind) : *from;
      given[i] = v;
    }
    int code[2];
    for (int turn = 0; turn < 2; turn++) {
      const real *seen[32];
      real *wanted[32];
      for (int i = 0; i < f->n_arg; i++) seen[i] = i == missing ? NULL : given[i];
      for (int i = 0; i < f->n_res; i++) {
        out[turn][i] = room((size_t)f->res[i], sizeof(real));
        memset(out[turn][i], 0x55, (size_t)f->res[i] * sizeof(real));
        wanted[i] = i == unwanted ? NULL : out[turn][i];
      }
      code[turn] = called(f, seen, wanted, turn ? 0xff : 0x11);
    }
    int finite = 1, same = code[0] == code[1];
    for (int i = 0; i < f->n_res; i++)
      for (int j = 0; j < f->res[i]; j++) {
        real a = out[0][i][j], b = out[1][i][j];
        finite = finite && isfinite(a);
        same = same && (a == b || (isnan(a) && isnan(b)));
      }
    counts[kind][0]++;
    counts[kind][code[0] ? 3 : (finite ? 1 : 2)]++;
    if (!same || (kind == NOMINAL && (code[0] || !finite))) {
      broken++;
      printf("broken %s %s step %ld code %d %d finite %d same %d\n", f->name, NAMES[kind], step, code[0], code[1], finite, same);
    }
    for (int i = 0; i < f->n_arg; i++) free((void *)(uintptr_t)given[i]);
    for (int i = 0; i < f->n_res; i++) free(out[0][i]), free(out[1][i]);
  }
  for (int k = 0; k < KINDS; k++)
    printf("%s %ld %ld %ld %ld\n", NAMES[k], counts[k][0], counts[k][1], counts[k][2], counts[k][3]);
  return broken ? 1 : 0;
}
