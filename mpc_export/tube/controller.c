/* Real-time iterations of a nonlinear MPC with tightened constraints, in error coordinates of the model's manifold.

   One iteration: linearise along the present plan (x_k, u_k), propagate the covariance of the closed loop along it, turn it
   into back-offs of the constraints, solve the structured QP (HPIPM), move the plan by its solution. Repeated until the KKT
   residual is small it is a Gauss-Newton SQP method; once per sample it is the real-time iteration (Diehl, Bock and Schloeder
   2005, SIAM J. Control Optim. 43(5)). The covariance is fixed within an iteration (zero-order, Feng, Di Cairano and
   Quirynen 2020; Zanelli, Frey, Messerer and Diehl 2021).

   Stage variables of the QP are z = (d, v) and w: d the error state without disturbances (which no command moves), v the change of the previous
   command, w the change of the command. All sizes are macros of tube_sizes.h. */

#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include <blasfeo_d_aux_ext_dep.h>
#include <hpipm_d_ocp_qp.h>
#include <hpipm_d_ocp_qp_dim.h>
#include <hpipm_d_ocp_qp_ipm.h>
#include <hpipm_d_ocp_qp_res.h>
#include <hpipm_d_ocp_qp_sol.h>

#include "tube_model.h"
#include "tube_sizes.h"

#define NZ (NK + NU)
#define NV (NK + 2 * NU)
#define NL (NPL + 1)
#define NG (NL + NU)
#define FREE 1e12
#define QP_ITERATIONS 200

typedef struct {
  /* what the caller sets */
  double x0[NX];                 /* state to plan from */
  double u_before[NU];           /* command in force until then */
  double p[NP1];                 /* run-time parameters */
  double ref[N][NREF];           /* references of the running cost */
  double x_end[NX];              /* reference of the terminal cost */
  double plane[N + 1][NPL][4];   /* normal and offset, position . normal <= offset; zeros and 1: none */
  double u_min[NU], u_max[NU], rate_max[NU];
  double kappa[NL], kappa_u;     /* standard deviations by which constraints are tightened */
  double wider[N + 1][NL];       /* by how much wider errors are than the model says */
  double penalty, penalty_square;
  double Z0[ND * ND];            /* covariance of the estimate about the plan at its start, usually zero */
  double bent[N + 1][ND * ND];   /* added to the covariance: what the linear loop leaves out */
  double tolerance, qp_tolerance, damping;
  double primal_tolerance;       /* largest primal residual of a QP whose solution is taken over */
  double iterations_max, qp_iterations_max, tube_updates_max;
  /* the plan, also the start of the next solution */
  double x[N + 1][NX];
  double u[N][NU];
  /* results */
  double covariance[N + 1][ND * ND];
  double backoff[N + 1][NL];
  double backoff_u[N][NU];
  double slack[N + 1][NL];
  double cost, kkt, step, iterations, qp_iterations, qp_status;
  double qp_residual;            /* primal residual of the last QP: dynamics, commands, rates */
  double missed;                 /* how far the model, flown under the plan's commands, is from the plan */
  double clipped;                /* by how much the limits moved a command of the plan at the end */
  double seconds, seconds_linear, seconds_tube, seconds_qp;
} tube_data;

typedef struct {
  struct d_ocp_qp_dim dim;
  struct d_ocp_qp qp;
  struct d_ocp_qp_sol sol;
  struct d_ocp_qp_ipm_arg arg;
  struct d_ocp_qp_ipm_ws ws;
  struct d_ocp_qp_res res;
  struct d_ocp_qp_res_ws res_ws;
  void *memory[7];
  double w[TUBE_W];
  tube_model_int iw[TUBE_IW];
  double A[N][NK * NK], B[N][NK * NU];
  double G[N + 1][NL * NK], value[N + 1][NL];
  double c[ND * NGP1], b[ND * NTH1];
  double c2[ND * NGP1], b2[ND * NTH1], Z[ND * ND], Z2[ND * ND];
  double x_kept[N + 1][NX], u_kept[N][NU];
  tube_data first;
} tube_solver;

static double now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

size_t tube_data_size(void) { return sizeof(tube_data); }

void tube_free(tube_solver *s) {
  if (s != NULL) {
    for (int i = 0; i < 7; i++) free(s->memory[i]);
    free(s);
  }
}

/* A QP that broke down leaves NaN in the solver's memory: start it anew. */
static void renewed(tube_solver *s) {
  d_ocp_qp_create(&s->dim, &s->qp, s->memory[1]);
  d_ocp_qp_set_all_zero(&s->qp);
  d_ocp_qp_sol_create(&s->dim, &s->sol, s->memory[2]);
  d_ocp_qp_sol_set_zero(&s->sol);
  int most = QP_ITERATIONS;
  d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
  memset(s->memory[4], 0, (size_t)d_ocp_qp_ipm_ws_memsize(&s->dim, &s->arg));
  d_ocp_qp_ipm_ws_create(&s->dim, &s->arg, &s->ws, s->memory[4]);
}

static int sized(tube_solver *s) {
  struct d_ocp_qp_dim *dim = &s->dim;
  for (int k = 0; k <= N; k++) {
    d_ocp_qp_dim_set_nx(k, k > 0 ? NZ : 0, dim);
    d_ocp_qp_dim_set_nu(k, k < N ? NU : 0, dim);
    d_ocp_qp_dim_set_nbx(k, 0, dim);
    d_ocp_qp_dim_set_nbu(k, k < N ? NU : 0, dim);
    d_ocp_qp_dim_set_ng(k, k == 0 ? 0 : (k < N ? NG : NL), dim);
    d_ocp_qp_dim_set_ns(k, k > 0 ? NL : 0, dim);
  }
  s->memory[1] = malloc((size_t)d_ocp_qp_memsize(dim));
  s->memory[2] = malloc((size_t)d_ocp_qp_sol_memsize(dim));
  s->memory[3] = malloc((size_t)d_ocp_qp_ipm_arg_memsize(dim));
  if (!s->memory[1] || !s->memory[2] || !s->memory[3]) return 1;
  d_ocp_qp_create(dim, &s->qp, s->memory[1]);
  d_ocp_qp_set_all_zero(&s->qp);
  d_ocp_qp_sol_create(dim, &s->sol, s->memory[2]);
  d_ocp_qp_ipm_arg_create(dim, &s->arg, s->memory[3]);
  d_ocp_qp_ipm_arg_set_default(SPEED, &s->arg);
  /* where slacks and multipliers begin, as acados sets it: half as many iterations as HPIPM's default */
  int scheme = 1;
  d_ocp_qp_ipm_arg_set_var_init_scheme(&scheme, &s->arg);
  /* the statistics of this many iterations are part of the workspace */
  int most = QP_ITERATIONS;
  d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
  s->memory[4] = malloc((size_t)d_ocp_qp_ipm_ws_memsize(dim, &s->arg));
  s->memory[5] = malloc((size_t)d_ocp_qp_res_memsize(dim));
  s->memory[6] = malloc((size_t)d_ocp_qp_res_ws_memsize(dim));
  if (!s->memory[4] || !s->memory[5] || !s->memory[6]) return 1;
  d_ocp_qp_ipm_ws_create(dim, &s->arg, &s->ws, s->memory[4]);
  d_ocp_qp_res_create(dim, &s->res, s->memory[5]);
  d_ocp_qp_res_ws_create(dim, &s->res_ws, s->memory[6]);
  return 0;
}

tube_solver *tube_create(void) {
  tube_solver *s = calloc(1, sizeof(tube_solver));
  if (s == NULL) return NULL;
  s->memory[0] = malloc((size_t)d_ocp_qp_dim_memsize(N));
  if (s->memory[0] == NULL) {
    tube_free(s);
    return NULL;
  }
  d_ocp_qp_dim_create(N, &s->dim, s->memory[0]);
  if (sized(s)) {
    tube_free(s);
    return NULL;
  }
  return s;
}

/* Linearises stage k: A, B, and the defect of the plan there. Disturbances go where the model takes them. */
static int dynamics(tube_solver *s, tube_data *d, int k, double *defect) {
  static const int moved[NFREE1] = TUBE_FREE;
  double next[NX];
  const double *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p};
  double *res[TUBE_RES] = {next, s->A[k], s->B[k]};
  if (tube_model_tube_linear(arg, res, s->iw, s->w, 0)) return 1;
  for (int j = 0; j < NFREE; j++) d->x[k + 1][moved[j]] = next[moved[j]];
  const double *gap_arg[TUBE_ARG] = {next, d->x[k + 1]};
  double *gap_res[TUBE_RES] = {defect};
  return tube_model_tube_gap(gap_arg, gap_res, s->iw, s->w, 0);
}

static int limits(tube_solver *s, const tube_data *d, int k) {
  const double *arg[TUBE_ARG] = {d->x[k], d->plane[k][0]};
  double *res[TUBE_RES] = {s->value[k], s->G[k]};
  return tube_model_tube_limits(arg, res, s->iw, s->w, 0);
}

/* Covariance of the closed loop along the plan, and what it takes off every constraint. */
static int tube(tube_solver *s, tube_data *d) {
  static const int keep[NK] = TUBE_KEEP;
  static const double gain[NU * ND] = TUBE_GAIN;
  memcpy(s->Z, d->Z0, sizeof s->Z);
  memset(s->c, 0, sizeof s->c);
  memset(s->b, 0, sizeof s->b);
  for (int k = 0; k <= N; k++) {
    const double *uk = d->u[k < N ? k : N - 1];
    const double *arg[TUBE_ARG] = {d->x[k], uk, d->p, s->Z, s->c, s->b};
    double *res[TUBE_RES] = {d->covariance[k], s->Z2, s->c2, s->b2};
    if (tube_model_tube_spread(arg, res, s->iw, s->w, 0)) return 1;
    double *total = d->covariance[k];
    for (int i = 0; i < ND * ND; i++) total[i] += d->bent[k][i];
    for (int j = 0; j < NL; j++) {
      double sum = 0;
      for (int m = 0; m < NK; m++) {
        double row = 0;
        if (s->G[k][m * NL + j] == 0.0) continue;
        for (int i = 0; i < NK; i++) row += s->G[k][i * NL + j] * total[keep[m] * ND + keep[i]];
        sum += s->G[k][m * NL + j] * row;
      }
      d->backoff[k][j] = k > 0 ? d->kappa[j] * d->wider[k][j] * sqrt(sum > 0 ? sum : 0) : 0;
    }
    if (k < N) {
      /* What the ancillary gain adds to the command: K (Z + c c' + b b') K', without the filter's error. */
      for (int j = 0; j < NU; j++) {
        double sum = 0;
        for (int m = 0; m < ND; m++) {
          double row = 0;
          for (int i = 0; i < ND; i++) row += gain[i * NU + j] * (total[m * ND + i] - d->covariance[0][m * ND + i]);
          sum += gain[m * NU + j] * row;
        }
        d->backoff_u[k][j] = k > 0 ? d->kappa_u * sqrt(sum > 0 ? sum : 0) : 0;
        double room = 0.45 * (d->u_max[j] - d->u_min[j]);
        if (d->backoff_u[k][j] > room) d->backoff_u[k][j] = room;
      }
    }
    memcpy(s->Z, s->Z2, sizeof s->Z);
    memcpy(s->c, s->c2, sizeof s->c);
    memcpy(s->b, s->b2, sizeof s->b);
  }
  return 0;
}

/* Fills stage k of the QP. */
static int stage(tube_solver *s, tube_data *d, int k) {
  struct d_ocp_qp *qp = &s->qp;
  double value, g[NV], H[NV * NV];
  if (k < N) {
    const double *before = k > 0 ? d->u[k - 1] : d->u_before;
    const double *arg[TUBE_ARG] = {d->x[k], d->u[k], before, d->ref[k]};
    double *res[TUBE_RES] = {&value, g, H};
    if (tube_model_tube_cost(arg, res, s->iw, s->w, 0)) return 1;
    double R[NU * NU], S[NU * NZ], Q[NZ * NZ], A[NZ * NZ], B[NZ * NU], b[NZ] = {0};
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NU; i++) R[j * NU + i] = H[(NZ + j) * NV + NZ + i] + (i == j ? d->damping : 0);
    d_ocp_qp_set_R(k, R, qp);
    d_ocp_qp_set_r(k, g + NZ, qp);
    if (k > 0) {
      for (int j = 0; j < NZ; j++) {
        for (int i = 0; i < NU; i++) S[j * NU + i] = H[j * NV + NZ + i];
        for (int i = 0; i < NZ; i++) Q[j * NZ + i] = H[j * NV + i] + (i == j ? 1e-9 : 0);
      }
      d_ocp_qp_set_S(k, S, qp);
      d_ocp_qp_set_Q(k, Q, qp);
      d_ocp_qp_set_q(k, g, qp);
    }
    if (dynamics(s, d, k, b)) return 1;
    memset(A, 0, sizeof A);
    memset(B, 0, sizeof B);
    for (int j = 0; j < NK; j++)
      for (int i = 0; i < NK; i++) A[j * NZ + i] = s->A[k][j * NK + i];
    for (int j = 0; j < NU; j++) {
      for (int i = 0; i < NK; i++) B[j * NZ + i] = s->B[k][j * NK + i];
      B[j * NZ + NK + j] = 1;
    }
    if (k > 0) d_ocp_qp_set_A(k, A, qp);
    d_ocp_qp_set_B(k, B, qp);
    d_ocp_qp_set_b(k, b, qp);
    d->cost += value;
  } else {
    double Q[NZ * NZ] = {0}, q[NZ] = {0}, h[NK * NK], grad[NK];
    const double *arg[TUBE_ARG] = {d->x[N], d->x_end};
    double *res[TUBE_RES] = {&value, grad, h};
    if (tube_model_tube_end(arg, res, s->iw, s->w, 0)) return 1;
    for (int j = 0; j < NK; j++) {
      q[j] = grad[j];
      for (int i = 0; i < NK; i++) Q[j * NZ + i] = h[j * NK + i];
    }
    for (int j = 0; j < NZ; j++) Q[j * NZ + j] += 1e-9;
    d_ocp_qp_set_Q(N, Q, qp);
    d_ocp_qp_set_q(N, q, qp);
    d->cost += value;
  }
  return 0;
}

static void bounds(tube_solver *s, tube_data *d, int k) {
  struct d_ocp_qp *qp = &s->qp;
  if (k < N) {
    double lower[NU], upper[NU];
    int at[NU];
    const double *before = k > 0 ? d->u[k - 1] : d->u_before;
    for (int j = 0; j < NU; j++) {
      at[j] = j;
      lower[j] = d->u_min[j] + d->backoff_u[k][j] - d->u[k][j];
      upper[j] = d->u_max[j] - d->backoff_u[k][j] - d->u[k][j];
      if (k == 0) {
        double low = before[j] - d->rate_max[j] - d->u[k][j], high = before[j] + d->rate_max[j] - d->u[k][j];
        /* A command in force beyond the limits goes back as fast as it may. */
        lower[j] = lower[j] > low ? (lower[j] < high ? lower[j] : high) : low;
        upper[j] = upper[j] < high ? (upper[j] > low ? upper[j] : low) : high;
      }
    }
    d_ocp_qp_set_idxbu(k, at, qp);
    d_ocp_qp_set_lbu(k, lower, qp);
    d_ocp_qp_set_ubu(k, upper, qp);
  }
  if (k == 0) return;
  int ng = k < N ? NG : NL, idxs[NL];
  double C[NG * NZ] = {0}, D[NG * NU] = {0}, lg[NG], ug[NG], mask[NG], linear[NL], square[NL], none[NL] = {0};
  for (int j = 0; j < NL; j++) {
    for (int i = 0; i < NK; i++) C[i * ng + j] = s->G[k][i * NL + j];
    lg[j] = -FREE;
    mask[j] = 0;
    ug[j] = -s->value[k][j] - d->backoff[k][j];
    idxs[j] = (k < N ? NU : 0) + j;
    linear[j] = d->penalty;
    square[j] = d->penalty_square;
  }
  if (k < N) {
    for (int j = 0; j < NU; j++) {
      double change = d->u[k][j] - d->u[k - 1][j];
      C[(NK + j) * ng + NL + j] = -1;
      D[j * ng + NL + j] = 1;
      lg[NL + j] = -d->rate_max[j] - change;
      ug[NL + j] = d->rate_max[j] - change;
      mask[NL + j] = 1;
    }
    d_ocp_qp_set_D(k, D, qp);
  }
  d_ocp_qp_set_C(k, C, qp);
  d_ocp_qp_set_lg(k, lg, qp);
  d_ocp_qp_set_ug(k, ug, qp);
  d_ocp_qp_set_lg_mask(k, mask, qp);
  d_ocp_qp_set_idxs(k, idxs, qp);
  d_ocp_qp_set_Zu(k, square, qp);
  d_ocp_qp_set_zu(k, linear, qp);
  d_ocp_qp_set_Zl(k, square, qp);
  d_ocp_qp_set_zl(k, linear, qp);
  d_ocp_qp_set_lls(k, none, qp);
  d_ocp_qp_set_lus(k, none, qp);
}

/* The larger of two sizes; infinite where one is no number, so that a NaN is never lost among numbers. */
static double larger(double a, double b) {
  if (isnan(a) || isnan(b)) return INFINITY;
  return a > b ? a : b;
}

static double largest(const double *v, int n) {
  double m = 0;
  for (int i = 0; i < n; i++) m = larger(m, fabs(v[i]));
  return m;
}

static double clip(double v, double low, double high) { return v < low ? low : (v > high ? high : v); }

/* Commands of the plan within their limits and, which comes first, their rates. Returns the largest change. */
static double limited(tube_data *d) {
  double most = 0;
  for (int k = 0; k < N; k++) {
    const double *before = k > 0 ? d->u[k - 1] : d->u_before;
    for (int j = 0; j < NU; j++) {
      double v = clip(d->u[k][j], d->u_min[j], d->u_max[j]);
      v = clip(v, before[j] - d->rate_max[j], before[j] + d->rate_max[j]);
      most = larger(most, fabs(v - d->u[k][j]));
      d->u[k][j] = v;
    }
  }
  return most;
}

/* How far the solution of the QP is from its dynamics and its limits, of its multipliers nothing. */
static double primal(tube_solver *s) {
  double eq, ineq;
  d_ocp_qp_res_compute(&s->qp, &s->sol, &s->res, &s->res_ws);
  d_ocp_qp_res_compute_inf_norm(&s->res);
  d_ocp_qp_res_get_max_res_eq(&s->res, &eq);
  d_ocp_qp_res_get_max_res_ineq(&s->res, &ineq);
  return larger(eq, ineq);
}

/* KKT residual of the plan as it is now, with the multipliers of the QP before. */
static double residual(tube_solver *s) {
  double zero[NZ] = {0}, m, v;
  for (int k = 0; k <= N; k++) {
    if (k > 0) d_ocp_qp_sol_set_x(k, zero, &s->sol);
    if (k < N) d_ocp_qp_sol_set_u(k, zero, &s->sol);
  }
  d_ocp_qp_res_compute(&s->qp, &s->sol, &s->res, &s->res_ws);
  d_ocp_qp_res_compute_inf_norm(&s->res);
  d_ocp_qp_res_get_max_res_stat(&s->res, &v);
  m = v;
  d_ocp_qp_res_get_max_res_eq(&s->res, &v);
  m = larger(m, v);
  d_ocp_qp_res_get_max_res_ineq(&s->res, &v);
  m = larger(m, v);
  d_ocp_qp_res_get_max_res_comp(&s->res, &v);
  return larger(m, v);
}

/* How far the model, flown from the plan's start under its commands, is from the plan, to first order: the gaps of the
   moved plan, carried along its linearisation. With the right commands the next step would have this size. */
static int missed(tube_solver *s, tube_data *d) {
  double away[NK] = {0};
  d->missed = 0;
  for (int k = 0; k < N; k++) {
    double next[NX], gap[NK];
    const double *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p}, *gap_arg[TUBE_ARG] = {next, d->x[k + 1]};
    double *res[TUBE_RES] = {next}, *gap_res[TUBE_RES] = {gap};
    if (tube_model_tube_step(arg, res, s->iw, s->w, 0)) return 1;
    if (tube_model_tube_gap(gap_arg, gap_res, s->iw, s->w, 0)) return 1;
    for (int j = 0; j < NK; j++)
      for (int i = 0; i < NK; i++) gap[i] += s->A[k][j * NK + i] * away[j];
    memcpy(away, gap, sizeof away);
    d->missed = larger(d->missed, largest(away, NK));
  }
  return 0;
}

/* One QP about the plan: solves it and moves the plan by the solution. Returns what tube_solve does. */
static int moved_by_qp(tube_solver *s, tube_data *d) {
  double z[N + 1][NZ], w[N][NU], size = 0;
  int status, n;
  d_ocp_qp_ipm_solve(&s->qp, &s->sol, &s->arg, &s->ws);
  d_ocp_qp_ipm_get_status(&s->ws, &status);
  d_ocp_qp_ipm_get_iter(&s->ws, &n);
  d->qp_status = status;
  d->qp_iterations += n;
  d->qp_residual = primal(s);
  for (int k = 0; k <= N; k++) {
    if (k > 0) {
      d_ocp_qp_sol_get_x(k, &s->sol, z[k]);
      d_ocp_qp_sol_get_su(k, &s->sol, d->slack[k]);
      size = larger(size, largest(z[k], NK));
    }
    if (k < N) {
      d_ocp_qp_sol_get_u(k, &s->sol, w[k]);
      size = larger(size, largest(w[k], NU));
    }
  }
  /* A QP that broke down, or was cut off before it met its dynamics and limits, gives no plan. One that did meet them is
     a plan, if not the best. */
  if (!(size < 1e6) || status > 2 || !(d->qp_residual <= d->primal_tolerance)) return 2;
  d->step = size;
  for (int k = 0; k <= N; k++) {
    if (k > 0) {
      double moved[NX];
      const double *arg[TUBE_ARG] = {d->x[k], z[k]};
      double *res[TUBE_RES] = {moved};
      if (tube_model_tube_move(arg, res, s->iw, s->w, 0)) return 1;
      memcpy(d->x[k], moved, sizeof moved);
    }
    if (k < N)
      for (int j = 0; j < NU; j++) d->u[k][j] += w[k][j];
  }
  return 0;
}

static int iterated(tube_solver *s, tube_data *d) {
  int cold = 0, warm = 2;
  d_ocp_qp_ipm_arg_set_warm_start(&cold, &s->arg);
  for (int it = 0; it <= (int)d->iterations_max; it++) {
    double t0 = now(), t1, t2;
    d->cost = 0;
    for (int k = 0; k <= N; k++)
      if (limits(s, d, k) || stage(s, d, k)) return 1;
    t1 = now();
    if (it < (int)d->tube_updates_max && tube(s, d)) return 1;
    for (int k = 0; k <= N; k++) bounds(s, d, k);
    t2 = now();
    d->seconds_linear += t1 - t0;
    d->seconds_tube += t2 - t1;
    if (it > 0) {
      /* with one iteration a sample nobody needs the residual */
      if (d->iterations_max > 1) d->kkt = residual(s);
      if (d->kkt <= d->tolerance) break;
    }
    if (it == (int)d->iterations_max) break;
    /* the QP of the iteration before is near; that of the sample before may have other active limits */
    if (it > 0) d_ocp_qp_ipm_arg_set_warm_start(&warm, &s->arg);
    int failed = moved_by_qp(s, d);
    d->seconds_qp += now() - t2;
    if (failed) return failed;
    d->iterations = it + 1;
    if ((int)d->iterations_max == 1) break;
  }
  if (!(largest(&d->x[0][0], (N + 1) * NX) < INFINITY) || !(largest(&d->u[0][0], N * NU) < INFINITY)) return 1;
  return missed(s, d);
}

/* The next step of Newton's method as a part of the last: it converges below 1 (Deuflhard 2011, Newton methods for
   nonlinear problems, section 2.1). 0 where the plan meets its dynamics, infinite without a plan. */
static double contraction(const tube_data *d, int failed) {
  if (failed) return INFINITY;
  return d->missed <= d->primal_tolerance ? 0 : d->missed / d->step;
}

/* The plan's commands, flown by the model from where the craft is: a start that owes nothing to the states planned before,
   which a wild measurement may have sent anywhere. */
static int simulated(tube_solver *s, tube_data *d) {
  memcpy(d->x[0], d->x0, sizeof d->x[0]);
  for (int k = 0; k < N; k++) {
    const double *arg[TUBE_ARG] = {d->x[k], d->u[k], d->p};
    double *res[TUBE_RES] = {d->x[k + 1]};
    if (tube_model_tube_step(arg, res, s->iw, s->w, 0)) return 1;
  }
  return 0;
}

/* Iterates from the plan in d; where that fails or its steps grow, also from its commands flown by the model, and takes
   the better. Returns 0; 1 where a function of the model failed or the plan is not finite; 2 where the QP was
   not solved; 3 where Newton's steps grow. After 1 to 3 the plan is the one from before the call, to the last bit. After 0
   its commands keep their limits and rates exactly; qp_status 1 or 2 then says that the QP was not solved to the end,
   though it met dynamics and limits to primal_tolerance. d->kkt <= d->tolerance says that the iterations converged. */
int tube_solve(tube_solver *s, tube_data *d) {
  double begin = now();
  int most = d->qp_iterations_max < QP_ITERATIONS ? (int)d->qp_iterations_max : QP_ITERATIONS;
  d->seconds_linear = d->seconds_tube = d->seconds_qp = 0;
  d->iterations = d->qp_iterations = d->clipped = 0;
  d->step = d->kkt = d->qp_residual = d->missed = INFINITY;
  d->qp_status = -1;
  d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_stat(&d->qp_tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_eq(&d->qp_tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_ineq(&d->qp_tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_comp(&d->qp_tolerance, &s->arg);
  memcpy(s->x_kept, d->x, sizeof d->x);
  memcpy(s->u_kept, d->u, sizeof d->u);
  memcpy(d->x[0], d->x0, sizeof d->x[0]);
  int failed = iterated(s, d);
  double ratio = contraction(d, failed);
  if (ratio >= 1) {
    s->first = *d;
    if (failed) renewed(s);
    d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
    memcpy(d->u, s->u_kept, sizeof d->u);
    int second = simulated(s, d) || iterated(s, d);
    if (contraction(d, second) < ratio) {
      ratio = contraction(d, second);
      failed = 0;
    } else {
      if (second) renewed(s);
      *d = s->first;
    }
  }
  if (!failed && ratio >= 1) failed = 3;
  if (failed) {
    memcpy(d->x, s->x_kept, sizeof d->x);
    memcpy(d->u, s->u_kept, sizeof d->u);
    renewed(s);
  } else {
    d->clipped = limited(d);
  }
  d->seconds = now() - begin;
  return failed;
}
