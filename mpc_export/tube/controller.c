/* Real-time iterations of a nonlinear MPC with tightened constraints, in error coordinates of the model's manifold.

   One iteration: linearise along the present plan (x_k, u_k), propagate the covariance of the closed loop along it, turn it
   into back-offs of the constraints, solve the structured QP (qp.h), move the plan by its solution. Repeated until the KKT
   residual is small it is a Gauss-Newton SQP method; once per sample it is the real-time iteration (Diehl, Bock and
   Schloeder 2005, SIAM J. Control Optim. 43(5)). The covariance is fixed within an iteration (zero-order, Feng, Di Cairano
   and Quirynen 2020; Zanelli, Frey, Messerer and Diehl 2021).

   All sizes are macros of tube_sizes.h, which also says of what precision a tube_real is. Nothing is allocated but by
   tube_create, which only a desktop has (TUBE_HOSTED). */

#ifdef TUBE_HOSTED
#include <time.h>
#endif
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "tube_model.h"
#include "tube_sizes.h"
#include "numbers.h"
#include "qp.h"
#include "qp_solver.c"

/* rows of square matrices and of errors that last, in tiles of four */
enum { SIDE = (ND + 3) / 4 * 4, LASTING = (NGP + NTH + 4) / 4 * 4, MOST = LASTING > SIDE ? LASTING : SIDE };

typedef struct {
  qp_solver solver;
  tube_qp qp;
  tube_qp_answer answer;
  tube_real w[TUBE_W];
  tube_model_int iw[TUBE_IW];
  tube_real A[N][TUBE_NONZEROS], B[N][ND * NU]; /* of all error states; nonzeros of A */
  tube_real value[N + 1][NL];
  tube_real closed[SIDE][SIDE], Z[SIDE][SIDE], Y[MOST][SIDE], lasting[LASTING][SIDE];
  tube_real x_kept[N + 1][NX], u_kept[N][NU];
  tube_data first;
} tube_solver;

static const int column[ND + 1] = TUBE_COLUMN, row[TUBE_NONZEROS] = TUBE_ROW;
static const int places[2] = TUBE_PLACES;
static const tube_real gain[NU][ND] = TUBE_GAIN, back[2] = TUBE_BACK;

#ifdef TUBE_HOSTED
#define TUBE_SOLVE
typedef double seconds;

static seconds now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + (double)t.tv_nsec / 1000000000;
}

size_t tube_data_size(void) { return sizeof(tube_data); }

void tube_free(tube_solver *s) {
  if (s != NULL) {
    qp_free(&s->solver);
    free(s);
  }
}

tube_solver *tube_create(void) {
  tube_solver *s = calloc(1, sizeof(tube_solver));
  if (s != NULL && qp_create(&s->solver)) {
    tube_free(s);
    return NULL;
  }
  return s;
}
#else
#define TUBE_SOLVE static
typedef tube_real seconds;

static seconds now(void) { return 0; }
#endif

/* Linearises stage k: A, B, and the defect of the plan there. Disturbances go where the model takes them. */
static int dynamics(tube_solver *s, tube_data *d, int k) {
  static const int moved[NFREE1] = TUBE_FREE;
  tube_real next[NX];
  const tube_real *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p};
  tube_real *res[TUBE_RES] = {next, s->qp.A[k], s->qp.B[k], s->A[k], s->B[k]};
  if (tube_model_tube_linear(arg, res, s->iw, s->w, 0)) return 1;
  for (int j = 0; j < NFREE; j++) d->x[k + 1][moved[j]] = next[moved[j]];
  const tube_real *gap_arg[TUBE_ARG] = {next, d->x[k + 1]};
  tube_real *gap_res[TUBE_RES] = {s->qp.b[k]};
  return tube_model_tube_gap(gap_arg, gap_res, s->iw, s->w, 0);
}

static int limits(tube_solver *s, const tube_data *d, int k) {
  const tube_real *arg[TUBE_ARG] = {d->x[k], d->plane[k][0]};
  tube_real *res[TUBE_RES] = {s->value[k], s->qp.G[k]};
  return tube_model_tube_limits(arg, res, s->iw, s->w, 0);
}

/* out = X Y' of matrices whose rows are SIDE long: tile by tile, so that a number loaded is used four times. lower: of a
   symmetric product tiles above the diagonal are left out. */
static void product(tube_real X[][SIDE], tube_real Y[][SIDE], int rows, int lower, tube_real out[][SIDE]) {
  for (int i = 0; i < rows; i += 4)
    for (int j = 0; j < (lower ? i + 4 : SIDE); j += 4) {
      tube_real sum[4][4] = {{0}};
      for (int m = 0; m < ND; m++)
        for (int a = 0; a < 4; a++)
          for (int b = 0; b < 4; b++) sum[a][b] += X[i + a][m] * Y[j + b][m];
      for (int a = 0; a < 4; a++)
        for (int b = 0; b < 4; b++) out[i + a][j + b] = sum[a][b];
    }
}

/* A_k + B_k K */
static void closed_loop(tube_solver *s, int k) {
  for (int i = 0; i < ND; i++) {
    tube_real *line = s->closed[i];
    for (int m = 0; m < ND; m++) line[m] = 0;
    for (int j = 0; j < NU; j++) {
      tube_real b = s->B[k][j * ND + i];
      if (b != 0)
        for (int m = 0; m < ND; m++) line[m] += b * gain[j][m];
    }
  }
  for (int j = 0; j < ND; j++)
    for (int i = column[j]; i < column[j + 1]; i++) s->closed[row[i]][j] += s->A[k][i];
}

static tube_real trace(const tube_solver *s) {
  tube_real sum = 0;
  for (int i = 0; i < ND; i++) sum += s->Z[i][i];
  return sum;
}

/* Z+ from Z, see stages.py; pushed: of the learned functions, for errors that are fresh at every stage. */
static void propagated(tube_solver *s, const tube_real *pushed) {
  static const tube_real fresh[ND * ND] = TUBE_FRESH;
  tube_real own = 1, other = 1, added;
  product(s->closed, s->Z, SIDE, 0, s->Y);
  product(s->Y, s->closed, SIDE, 1, s->Z);
  if (TUBE_WORST_CASE) {
    tube_real spread = trace(s), more = 0, ratio;
    for (int i = 0; i < ND; i++) more += fresh[i * ND + i];
    for (int i = 0; TUBE_WHITE && i < ND * NGP; i++) more += pushed[i] * pushed[i];
    ratio = sqrt(spread / fmax(more, 1e-30));
    /* at the start there is nothing to add to */
    own = spread > 0 ? 1 + 1 / fmax(ratio, 1e-12) : 0;
    other = spread > 0 ? 1 + ratio : 1;
  }
  for (int j = 0; j < ND; j++)
    for (int i = 0; i <= j; i++) {
      added = fresh[j * ND + i];
      for (int m = 0; TUBE_WHITE && m < NGP; m++) added += pushed[m * ND + i] * pushed[m * ND + j];
      s->Z[j][i] = s->Z[i][j] = own * s->Z[j][i] + other * added;
    }
}

/* total = P_f + Z + D + c c' + b Cov(theta) b' */
static void summed(const tube_solver *s, const tube_data *d, int k, tube_real total[ND][ND]) {
  static const tube_real estimate[ND * ND] = TUBE_ESTIMATE;
  for (int j = 0; j < ND; j++)
    for (int i = 0; i <= j; i++) {
      tube_real sum = estimate[j * ND + i] + s->Z[j][i] + d->bent[k][j][i];
      for (int m = 0; m < NGP + NTH; m++) sum += s->lasting[m][i] * s->lasting[m][j];
      total[j][i] = total[i][j] = sum;
    }
}

/* What the covariance takes off the limits of stage k, and the ancillary gain off the commands: K (Z + c c' + b b') K',
   without the filter's error. */
static void back_off(const tube_solver *s, tube_data *d, int k) {
  static const int keep[NK] = TUBE_KEEP;
  tube_real(*total)[ND] = d->covariance[k], taken[NU] = {0};
  for (int j = 0; j < NL; j++) {
    tube_real sum = 0;
    for (int m = 0; m < NK; m++) {
      tube_real part = 0, by = s->qp.G[k][m * NL + j];
      if (by == 0) continue;
      for (int i = 0; i < NK; i++) part += s->qp.G[k][i * NL + j] * total[keep[m]][keep[i]];
      sum += by * part;
    }
    d->backoff[k][j] = k > 0 ? d->kappa[j] * d->wider[k][j] * sqrt(sum > 0 ? sum : 0) : 0;
  }
  for (int m = 0; k > 0 && k < N && m < ND; m++) {
    tube_real part[NU] = {0};
    for (int i = 0; i <= m; i++) {
      tube_real more = (i < m ? 2 : 1) * (total[m][i] - d->covariance[0][m][i]);
      for (int j = 0; j < NU; j++) part[j] += gain[j][i] * more;
    }
    for (int j = 0; j < NU; j++) taken[j] += gain[j][m] * part[j];
  }
  for (int j = 0; k < N && j < NU; j++) {
    tube_real room = 0.45 * (d->u_max[j] - d->u_min[j]);
    d->backoff_u[k][j] = d->kappa_u * sqrt(taken[j] > 0 ? taken[j] : 0);
    if (d->backoff_u[k][j] > room) d->backoff_u[k][j] = room;
  }
}

/* Covariance of the closed loop along the plan, and what it takes off every constraint. Errors that last, c and b, travel
   as rows of one matrix, those of the parameters by a root of their covariance. */
static int tube(tube_solver *s, tube_data *d) {
  static const tube_real root[NTH1][NTH1] = TUBE_ROOT;
  tube_real push[ND * NGP1], slope[ND * NTH1];
  memset(s->lasting, 0, sizeof s->lasting);
  for (int j = 0; j < ND; j++) memcpy(s->Z[j], d->Z0[j], sizeof d->Z0[j]);
  for (int k = 0; k <= N; k++) {
    summed(s, d, k, d->covariance[k]);
    back_off(s, d, k);
    if (k == N) break;
    const tube_real *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p};
    tube_real *res[TUBE_RES] = {push, slope};
    if (tube_model_tube_unsure(arg, res, s->iw, s->w, 0)) return 1;
    closed_loop(s, k);
    propagated(s, push);
    if (NGP + NTH == 0) continue;
    product(s->lasting, s->closed, LASTING, 0, s->Y);
    memcpy(s->lasting, s->Y, sizeof s->lasting);
    for (int m = 0; m < NGP; m++)
      for (int i = 0; i < ND; i++) s->lasting[m][i] = TUBE_WHITE ? 0 : s->lasting[m][i] + push[m * ND + i];
    for (int j = 0; j < NTH; j++)
      for (int m = 0; m < NTH; m++)
        for (int i = 0; root[m][j] != 0 && i < ND; i++) s->lasting[NGP + j][i] += root[m][j] * slope[m * ND + i];
  }
  return 0;
}

static int nothing_infinite(const tube_real *v, int n) {
  tube_real sum = 0;
  UNROLLED
  for (int i = 0; i < n; i++) sum += 0 * v[i];
  return sum == 0;
}

/* Whether what the model's functions said of the plan is finite: else they failed, and not the QP that is made of it. */
static int sound(const tube_solver *s, const tube_data *d) {
  const tube_qp *q = &s->qp;
  return nothing_infinite(q->A[0], N * TUBE_PLAN_NONZEROS) && nothing_infinite(q->B[0], N * NK * NU) &&
         nothing_infinite(q->b[0], N * NK) && nothing_infinite(q->g[0], N * NV) && nothing_infinite(q->g_end, NK) &&
         nothing_infinite(s->value[0], (N + 1) * NL) && nothing_infinite(q->G[0], (N + 1) * NL * NK) &&
         nothing_infinite(d->backoff[0], (N + 1) * NL) && nothing_infinite(&d->cost, 1);
}

/* Cost and dynamics of stage k of the QP. */
static int stage(tube_solver *s, tube_data *d, int k) {
  tube_real value;
  if (k < N) {
    const tube_real *arg[TUBE_ARG] = {d->x[k], d->u[k], k > 0 ? d->u[k - 1] : d->u_before, d->ref[k]};
    tube_real H[TUBE_COST_NONZEROS], *res[TUBE_RES] = {&value, s->qp.g[k], H};
    if (tube_model_tube_cost(arg, res, s->iw, s->w, 0)) return 1;
    for (int j = NZ; j < NV; j++) s->qp.H[k][j * NV + j] = 0;
    for (int i = 0; i < TUBE_COST_NONZEROS; i++) s->qp.H[k][cost_across[i] * NV + cost_row[i]] = H[i];
    for (int j = NZ; j < NV; j++) s->qp.H[k][j * NV + j] += d->damping;
    if (dynamics(s, d, k)) return 1;
  } else {
    const tube_real *arg[TUBE_ARG] = {d->x[N], d->x_end};
    tube_real *res[TUBE_RES] = {&value, s->qp.g_end, s->qp.H_end};
    if (tube_model_tube_end(arg, res, s->iw, s->w, 0)) return 1;
  }
  d->cost += value;
  return 0;
}

/* How far beyond a plane a craft is in t seconds that turns back with half of what the limit of tilt gives; nothing where it
   is on its side, and all that can stop it before. */
static tube_real passed(const tube_data *d, const tube_real *plane, tube_real t) {
  tube_real beyond = -plane[3], away = 0;
  for (int i = 0; i < 3; i++) {
    beyond += plane[i] * d->x0[places[0] + i];
    away += plane[i] * d->x0[places[1] + i];
  }
  if (beyond + 0.5 * fmax(away, 0) * away / back[1] <= 0) return 0;
  return fmax(beyond + (away - 0.25 * back[1] * t) * t, 0);
}

/* How far stage k may be beyond plane j, if that is there now and then: to want more would be paid in tilt, and come no
   sooner. */
static tube_real returning(const tube_data *d, int j, int k) {
  const tube_real t = back[0] * (tube_real)k;
  if (j == NL - 1) return 0; /* the tilt */
  return fmin(passed(d, d->plane[0][j], t), passed(d, d->plane[k][j], t));
}

static void bounds(tube_solver *s, tube_data *d, int k) {
  const tube_real *before = k > 0 ? d->u[k - 1] : d->u_before;
  for (int j = 0; k < N && j < NU; j++) {
    tube_real lower = d->u_min[j] + d->backoff_u[k][j] - d->u[k][j];
    tube_real upper = d->u_max[j] - d->backoff_u[k][j] - d->u[k][j];
    if (k == 0) {
      tube_real low = before[j] - d->rate_max[j] - d->u[k][j], high = before[j] + d->rate_max[j] - d->u[k][j];
      /* A command in force beyond the limits goes back as fast as it may. */
      lower = lower > low ? (lower < high ? lower : high) : low;
      upper = upper < high ? (upper > low ? upper : low) : high;
    }
    s->qp.lower[k][j] = lower;
    s->qp.upper[k][j] = upper;
    s->qp.change[k][j] = d->u[k][j] - before[j];
    s->qp.rate_max[j] = d->rate_max[j];
  }
  for (int j = 0; k > 0 && j < NL; j++) s->qp.most[k][j] = returning(d, j, k) - s->value[k][j] - d->backoff[k][j];
  s->qp.penalty = d->penalty;
  s->qp.penalty_square = d->penalty_square;
}

/* Commands of the plan within their limits and, which comes first, their rates. Returns the largest change. */
static tube_real limited(tube_data *d) {
  tube_real most = 0;
  for (int k = 0; k < N; k++) {
    const tube_real *before = k > 0 ? d->u[k - 1] : d->u_before;
    for (int j = 0; j < NU; j++) {
      tube_real v = clip(d->u[k][j], d->u_min[j], d->u_max[j]);
      v = clip(v, before[j] - d->rate_max[j], before[j] + d->rate_max[j]);
      most = larger(most, fabs(v - d->u[k][j]));
      d->u[k][j] = v;
    }
  }
  return most;
}

/* How far the model, flown from the plan's start under its commands, is from the plan, to first order: the gaps of the
   moved plan, carried along its linearisation. With the right commands the next step would have this size. */
static int missed(tube_solver *s, tube_data *d) {
  tube_real away[NK] = {0};
  d->missed = 0;
  for (int k = 0; k < N; k++) {
    tube_real next[NX], gap[NK];
    const tube_real *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p}, *gap_arg[TUBE_ARG] = {next, d->x[k + 1]};
    tube_real *res[TUBE_RES] = {next}, *gap_res[TUBE_RES] = {gap};
    if (tube_model_tube_step(arg, res, s->iw, s->w, 0)) return 1;
    if (tube_model_tube_gap(gap_arg, gap_res, s->iw, s->w, 0)) return 1;
    plus_sparse(plan_column, plan_row, s->qp.A[k], NK, away, gap);
    memcpy(away, gap, sizeof away);
    d->missed = larger(d->missed, largest(away, NK));
  }
  return 0;
}

/* One QP about the plan: solves it and moves the plan by the solution. Returns what tube_solve does. */
static int moved_by_qp(tube_solver *s, tube_data *d, int warm) {
  tube_qp_answer *a = &s->answer;
  tube_real size = 0;
  qp_solve(&s->solver, &s->qp, d->qp_tolerance, (int)d->qp_iterations_max, warm, a);
  d->qp_status = (tube_real)a->status;
  d->qp_iterations += (tube_real)a->iterations;
  d->qp_residual = a->residual;
  for (int k = 0; k < N; k++) size = larger(size, larger(largest(a->d[k + 1], NK), largest(a->w[k], NU)));
  for (int k = 1; k <= N; k++)
    for (int j = 0; j < NL; j++) d->slack[k][j] = a->slack[k][j] + returning(d, j, k);
  /* A QP that broke down, or was cut off before it met its dynamics and limits, gives no plan. One that did meet them is
     a plan, if not the best. */
  if (!(size < 1e6) || a->status > 2 || !(d->qp_residual <= d->primal_tolerance)) return 2;
  d->step = size;
  for (int k = 0; k <= N; k++) {
    if (k > 0) {
      tube_real moved[NX];
      const tube_real *arg[TUBE_ARG] = {d->x[k], a->d[k]};
      tube_real *res[TUBE_RES] = {moved};
      if (tube_model_tube_move(arg, res, s->iw, s->w, 0)) return 1;
      memcpy(d->x[k], moved, sizeof moved);
    }
    for (int j = 0; k < N && j < NU; j++) d->u[k][j] += a->w[k][j];
  }
  return 0;
}

static int iterated(tube_solver *s, tube_data *d) {
  for (int it = 0; it <= (int)d->iterations_max; it++) {
    seconds t0 = now(), t1, t2;
    d->cost = 0;
    for (int k = 0; k <= N; k++)
      if (limits(s, d, k) || stage(s, d, k)) return 1;
    t1 = now();
    if (it < (int)d->tube_updates_max && tube(s, d)) return 1;
    if (!sound(s, d)) return 1;
    for (int k = 0; k <= N; k++) bounds(s, d, k);
    t2 = now();
    d->seconds_linear += (tube_real)(t1 - t0);
    d->seconds_tube += (tube_real)(t2 - t1);
    if (it > 0) {
      /* with one iteration a sample nobody needs the residual */
      if (d->iterations_max > 1) d->kkt = qp_kkt(&s->solver, &s->qp);
      if (d->kkt <= d->tolerance) break;
    }
    if (it == (int)d->iterations_max) break;
    /* the QP of the iteration before is near; that of the sample before may have other active limits */
    int failed = moved_by_qp(s, d, it > 0);
    d->seconds_qp += (tube_real)(now() - t2);
    if (failed) return failed;
    d->iterations = (tube_real)(it + 1);
    if ((int)d->iterations_max == 1) break;
  }
  if (!(largest(&d->x[0][0], (N + 1) * NX) < (tube_real)INFINITY) || !(largest(&d->u[0][0], N * NU) < (tube_real)INFINITY))
    return 1;
  return missed(s, d);
}

/* The next step of Newton's method as a part of the last: it converges below 1 (Deuflhard 2011, Newton methods for
   nonlinear problems, section 2.1). 0 where the plan meets its dynamics, infinite without a plan. */
static tube_real contraction(const tube_data *d, int failed) {
  if (failed) return (tube_real)INFINITY;
  return d->missed <= d->primal_tolerance ? 0 : d->missed / d->step;
}

/* The plan's commands, flown by the model from where the craft is: a start that owes nothing to the states planned before,
   which a wild measurement may have sent anywhere. */
static int simulated(tube_solver *s, tube_data *d) {
  memcpy(d->x[0], d->x0, sizeof d->x[0]);
  for (int k = 0; k < N; k++) {
    const tube_real *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p};
    tube_real *res[TUBE_RES] = {d->x[k + 1]};
    if (tube_model_tube_step(arg, res, s->iw, s->w, 0)) return 1;
  }
  return 0;
}

/* Iterates from the plan in d; where that fails or its steps grow, also from its commands flown by the model, and takes
   the better; with attempts_max = 1 the call after a failure begins there. Returns 0; 1 where a function of the model failed
   or the plan is not finite; 2 where the QP was not solved; 3 where Newton's steps grow. After 1 to 3 the plan is the one
   from before the call, to the last bit. After 0 its commands keep their limits and rates exactly; qp_status 1 or 2 then
   says that the QP was not solved to the end, though it met dynamics and limits to primal_tolerance. d->kkt <= d->tolerance
   says that the iterations converged. */
TUBE_SOLVE int tube_solve(tube_solver *s, tube_data *d) {
  seconds begin = now();
  d->seconds_linear = d->seconds_tube = d->seconds_qp = 0;
  d->iterations = d->qp_iterations = d->clipped = 0;
  d->step = d->kkt = d->qp_residual = d->missed = (tube_real)INFINITY;
  d->qp_status = -1;
  memcpy(s->x_kept, d->x, sizeof d->x);
  memcpy(s->u_kept, d->u, sizeof d->u);
  memcpy(d->x[0], d->x0, sizeof d->x[0]);
  int again = (int)d->attempts_max < 2 && d->failed != 0;
  int failed = again && simulated(s, d) ? 1 : iterated(s, d);
  tube_real ratio = contraction(d, failed);
  if (ratio >= 1 && (int)d->attempts_max > 1) {
    s->first = *d;
    if (failed) qp_renew(&s->solver);
    memcpy(d->u, s->u_kept, sizeof d->u);
    int second = simulated(s, d) || iterated(s, d);
    if (contraction(d, second) < ratio) {
      ratio = contraction(d, second);
      failed = 0;
    } else {
      if (second) qp_renew(&s->solver);
      *d = s->first;
    }
  }
  if (!failed && ratio >= 1) failed = 3;
  d->failed = failed != 0;
  if (failed) {
    memcpy(d->x, s->x_kept, sizeof d->x);
    memcpy(d->u, s->u_kept, sizeof d->u);
    qp_renew(&s->solver);
  } else {
    d->clipped = limited(d);
  }
  d->seconds = (tube_real)(now() - begin);
  return failed;
}
