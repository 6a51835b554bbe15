/* Fuzz of tube_solve, compiled behind controller.c: states, references, planes, parameters and weights of every kind, plan
   by plan, as a controller would go on with them.

       fuzz DATA STEPS SEED

   DATA is the tube_data of a solver that was reset: hover. Prints one line "kind steps solved cut refused outside
   not-finite changed" per kind of damage (the last: refused plans that were written to), then "slowest SECONDS", "back N
   of M": of M stretches without damage after a stretch with it, how many ended with a solution. Exit code 1 where one of
   the last three counts is not zero. SIGTERM ends it early, with what was counted until then. Whoever starts it sets the
   time after which it hangs. */

#include <signal.h>
#include <stdint.h>
#include <stdio.h>

enum { NOMINAL, NEAR, WILD, NOT_A_NUMBER, INFINITE, ZERO, CONSTANT, JUMP, DENORMAL, HUGE_NUMBER, MIXED, KINDS };
static const char *const NAMES[KINDS] = {"nominal", "near", "wild", "nan", "inf", "zero", "constant", "jump", "denormal",
                                         "huge", "mixed"};
#define STRETCH 25
#define REST 8

static volatile sig_atomic_t stopped;

static void stop(int number) {
  (void)number;
  stopped = 1;
}

static double damaged(double v, int kind, double constant) {
  switch (kind) {
    case NEAR: return v + 0.3 * (uniform() - 0.5);
    case WILD: return v + signed_power(-3, 12);
    case NOT_A_NUMBER: return NAN;
    case INFINITE: return uniform() < 0.5 ? INFINITY : -INFINITY;
    case ZERO: return 0.0;
    case CONSTANT: return constant;
    case JUMP: return v + (constant < 0 ? -1 : 1) * (1 + 9 * fabs(constant));
    case DENORMAL: return signed_power(-323, -308);
    case HUGE_NUMBER: return signed_power(100, 308);
    case MIXED: return damaged(v, 1 + drawn(MIXED - 1), constant);
    default: return v;
  }
}

static void damage(double *v, size_t n, double share, int kind, double constant) {
  for (size_t i = 0; i < n; i++)
    if (uniform() < share) v[i] = damaged(v[i], kind, constant);
}

/* Everything but the limits, the tolerances and the plan. */
static void damage_data(tube_data *d, int kind, double constant) {
  static const double shares[] = {0.02, 0.2, 1.0};
  double share = shares[drawn(3)];
  damage(d->x0, NX, share, kind, constant);
  if (uniform() < 0.3) damage(&d->ref[0][0], sizeof d->ref / sizeof(double), share, kind, constant);
  if (uniform() < 0.3) damage(d->x_end, NX, share, kind, constant);
  if (uniform() < 0.3) damage(&d->plane[0][0][0], sizeof d->plane / sizeof(double), share, kind, constant);
  if (uniform() < 0.1) damage(d->p, NP1, share, kind, constant);
  if (uniform() < 0.05) damage(d->kappa, NL, share, kind, constant);
  if (uniform() < 0.05) damage(d->wider[0], (N + 1) * NL, share, kind, constant);
  if (uniform() < 0.05) damage(&d->penalty, 2, share, kind, constant);
}

static int finite_plan(const tube_data *d) {
  return largest(&d->x[0][0], (N + 1) * NX) < INFINITY && largest(&d->u[0][0], N * NU) < INFINITY;
}

static int outside(const tube_data *d) {
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      double before = k > 0 ? d->u[k - 1][j] : d->u_before[j], u = d->u[k][j];
      if (!(u >= d->u_min[j] && u <= d->u_max[j] && fabs(u - before) <= d->rate_max[j] + 1e-12)) return 1;
    }
  return 0;
}

static void go_on(tube_data *d, const tube_data *hover, int failures) {
  if (failures >= 3) {
    memcpy(d->x, hover->x, sizeof d->x);
    for (int k = 0; k < N; k++) memcpy(d->u[k], d->u_before, sizeof d->u[k]);
    return;
  }
  memmove(d->x[0], d->x[1], N * sizeof d->x[0]);
  memmove(d->u[0], d->u[1], (N - 1) * sizeof d->u[0]);
}

int main(int argc, char **argv) {
  static tube_data hover, d, kept;
  long counts[KINDS][7] = {{0}}, broken = 0, back = 0, rests = 0;
  double slowest = 0, constant = 0;
  FILE *file = argc == 4 ? fopen(argv[1], "rb") : NULL;
  if (file == NULL || fread(&hover, sizeof hover, 1, file) != 1) return 2;
  fclose(file);
  long steps = atol(argv[2]);
  state_of_rng = UINT64_C(88172645463325252) + (uint64_t)atol(argv[3]) * UINT64_C(2654435761);
  tube_solver *solver = tube_create();
  if (solver == NULL) return 2;
  signal(SIGTERM, stop);
  d = hover;
  int kind = NOMINAL, failures = 0, status = 0;
  for (long i = 0; i < steps && !stopped; i++) {
    long at = i % (STRETCH + REST);
    if (at == 0) kind = 1 + drawn(KINDS - 1), constant = 2 * uniform() - 1;
    if (at == STRETCH) kind = NOMINAL;
    kept = d; /* the plan goes on, what is asked of it is asked anew */
    d = hover;
    memcpy(d.x, kept.x, sizeof d.x);
    memcpy(d.u, kept.u, sizeof d.u);
    memcpy(d.u_before, kept.u_before, sizeof d.u_before);
    damage_data(&d, kind, constant);
    go_on(&d, &hover, failures);
    kept = d;
    status = tube_solve(solver, &d);
    long *count = counts[kind];
    count[0]++;
    slowest = larger(slowest, d.seconds);
    if (status == 0) {
      failures = 0;
      count[d.qp_status == 0 ? 1 : 2]++;
      if (!finite_plan(&d)) count[5]++, broken++;
      else if (outside(&d)) count[4]++, broken++;
      memcpy(d.u_before, d.u[0], sizeof d.u_before);
    } else {
      failures++;
      count[3]++;
      if (memcmp(d.x, kept.x, sizeof d.x) || memcmp(d.u, kept.u, sizeof d.u)) count[6]++, broken++;
    }
    if (at == STRETCH + REST - 1) rests++, back += status == 0;
  }
  tube_free(solver);
  for (int k = 0; k < KINDS; k++)
    printf("%s %ld %ld %ld %ld %ld %ld %ld\n", NAMES[k], counts[k][0], counts[k][1], counts[k][2], counts[k][3], counts[k][4],
           counts[k][5], counts[k][6]);
  printf("slowest %.6f\nback %ld of %ld\n", slowest, back, rests);
  return broken ? 1 : 0;
}
