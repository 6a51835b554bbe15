/* The QP by HPIPM (Frison and Diehl 2020, IFAC-PapersOnLine 53(2)), for a desktop: memory is taken when it is created. */
#include <blasfeo_d_aux_ext_dep.h>
#include <hpipm_d_ocp_qp.h>
#include <hpipm_d_ocp_qp_dim.h>
#include <hpipm_d_ocp_qp_ipm.h>
#include <hpipm_d_ocp_qp_res.h>
#include <hpipm_d_ocp_qp_sol.h>

#define NG (NL + NU)
#define QP_ITERATIONS 200
#define QP_MEMORIES 7

typedef struct {
  struct d_ocp_qp_dim dim;
  struct d_ocp_qp qp;
  struct d_ocp_qp_sol sol;
  struct d_ocp_qp_ipm_arg arg;
  struct d_ocp_qp_ipm_ws ws;
  struct d_ocp_qp_res res;
  struct d_ocp_qp_res_ws res_ws;
  void *memory[QP_MEMORIES];
} qp_solver;

static void qp_free(qp_solver *s) {
  for (int i = 0; i < QP_MEMORIES; i++) free(s->memory[i]);
}

/* A QP that broke down leaves NaN in the solver's memory: start it anew. */
static void qp_renew(qp_solver *s) {
  d_ocp_qp_create(&s->dim, &s->qp, s->memory[1]);
  d_ocp_qp_set_all_zero(&s->qp);
  d_ocp_qp_sol_create(&s->dim, &s->sol, s->memory[2]);
  d_ocp_qp_sol_set_zero(&s->sol);
  int most = QP_ITERATIONS;
  d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
  memset(s->memory[4], 0, (size_t)d_ocp_qp_ipm_ws_memsize(&s->dim, &s->arg));
  d_ocp_qp_ipm_ws_create(&s->dim, &s->arg, &s->ws, s->memory[4]);
}

/* Returns 1 where there is no memory. */
static int qp_create(qp_solver *s) {
  s->memory[0] = malloc((size_t)d_ocp_qp_dim_memsize(N));
  if (!s->memory[0]) return 1;
  struct d_ocp_qp_dim *dim = &s->dim;
  d_ocp_qp_dim_create(N, dim, s->memory[0]);
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

static void qp_cost(struct d_ocp_qp *qp, tube_qp *q, int k) {
  tube_real R[NU * NU], S[NU * NZ], Q[NZ * NZ] = {0}, gradient[NZ] = {0};
  if (k < N) {
    const tube_real *H = q->H[k];
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NU; i++) R[j * NU + i] = H[(NZ + j) * NV + NZ + i];
    d_ocp_qp_set_R(k, R, qp);
    d_ocp_qp_set_r(k, q->g[k] + NZ, qp);
    if (k == 0) return;
    for (int j = 0; j < NZ; j++) {
      for (int i = 0; i < NU; i++) S[j * NU + i] = H[j * NV + NZ + i];
      for (int i = 0; i < NZ; i++) Q[j * NZ + i] = H[j * NV + i] + (i == j ? 1e-9 : 0);
    }
    d_ocp_qp_set_S(k, S, qp);
    memcpy(gradient, q->g[k], sizeof gradient);
  } else {
    for (int j = 0; j < NK; j++)
      for (int i = 0; i < NK; i++) Q[j * NZ + i] = q->H_end[j * NK + i];
    for (int j = 0; j < NZ; j++) Q[j * NZ + j] += 1e-9;
    memcpy(gradient, q->g_end, sizeof q->g_end);
  }
  d_ocp_qp_set_Q(k, Q, qp);
  d_ocp_qp_set_q(k, gradient, qp);
}

static void qp_dynamics(struct d_ocp_qp *qp, tube_qp *q, int k) {
  tube_real A[NZ * NZ] = {0}, B[NZ * NU] = {0}, b[NZ] = {0};
  for (int j = 0; j < NK; j++)
    for (int i = plan_column[j]; i < plan_column[j + 1]; i++) A[j * NZ + plan_row[i]] = q->A[k][i];
  for (int j = 0; j < NU; j++) {
    for (int i = 0; i < NK; i++) B[j * NZ + i] = q->B[k][j * NK + i];
    B[j * NZ + NK + j] = 1;
  }
  memcpy(b, q->b[k], sizeof q->b[k]);
  if (k > 0) d_ocp_qp_set_A(k, A, qp);
  d_ocp_qp_set_B(k, B, qp);
  d_ocp_qp_set_b(k, b, qp);
}

static void qp_limits(struct d_ocp_qp *qp, tube_qp *q, int k) {
  if (k < N) {
    int at[NU];
    for (int j = 0; j < NU; j++) at[j] = j;
    d_ocp_qp_set_idxbu(k, at, qp);
    d_ocp_qp_set_lbu(k, q->lower[k], qp);
    d_ocp_qp_set_ubu(k, q->upper[k], qp);
  }
  if (k == 0) return;
  int ng = k < N ? NG : NL, idxs[NL];
  tube_real C[NG * NZ] = {0}, D[NG * NU] = {0}, lg[NG], ug[NG], mask[NG], linear[NL], square[NL], none[NL] = {0};
  for (int j = 0; j < NL; j++) {
    for (int i = 0; i < NK; i++) C[i * ng + j] = q->G[k][i * NL + j];
    lg[j] = -1e12;
    mask[j] = 0;
    ug[j] = q->most[k][j];
    idxs[j] = (k < N ? NU : 0) + j;
    linear[j] = q->penalty;
    square[j] = q->penalty_square;
  }
  if (k < N) {
    for (int j = 0; j < NU; j++) {
      C[(NK + j) * ng + NL + j] = -1;
      D[j * ng + NL + j] = 1;
      lg[NL + j] = -q->rate_max[j] - q->change[k][j];
      ug[NL + j] = q->rate_max[j] - q->change[k][j];
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

static void qp_state(qp_solver *s, tube_qp *q) {
  for (int k = 0; k <= N; k++) {
    qp_cost(&s->qp, q, k);
    if (k < N) qp_dynamics(&s->qp, q, k);
    qp_limits(&s->qp, q, k);
  }
}

/* Solves the QP; warm: the solution before is near. */
static void qp_solve(qp_solver *s, tube_qp *q, tube_real tolerance, int most, int warm, tube_qp_answer *answer) {
  tube_real z[NZ], eq, ineq;
  int scheme = warm ? 2 : 0;
  if (most > QP_ITERATIONS) most = QP_ITERATIONS;
  d_ocp_qp_ipm_arg_set_warm_start(&scheme, &s->arg);
  d_ocp_qp_ipm_arg_set_iter_max(&most, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_stat(&tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_eq(&tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_ineq(&tolerance, &s->arg);
  d_ocp_qp_ipm_arg_set_tol_comp(&tolerance, &s->arg);
  qp_state(s, q);
  d_ocp_qp_ipm_solve(&s->qp, &s->sol, &s->arg, &s->ws);
  d_ocp_qp_ipm_get_status(&s->ws, &answer->status);
  d_ocp_qp_ipm_get_iter(&s->ws, &answer->iterations);
  d_ocp_qp_res_compute(&s->qp, &s->sol, &s->res, &s->res_ws);
  d_ocp_qp_res_compute_inf_norm(&s->res);
  d_ocp_qp_res_get_max_res_eq(&s->res, &eq);
  d_ocp_qp_res_get_max_res_ineq(&s->res, &ineq);
  answer->residual = larger(eq, ineq);
  for (int k = 0; k <= N; k++) {
    if (k > 0) {
      d_ocp_qp_sol_get_x(k, &s->sol, z);
      memcpy(answer->d[k], z, sizeof answer->d[k]);
      d_ocp_qp_sol_get_su(k, &s->sol, answer->slack[k]);
    }
    if (k < N) d_ocp_qp_sol_get_u(k, &s->sol, answer->w[k]);
  }
}

/* KKT residual of the plan that the QP is about, with the multipliers of the QP before. */
static tube_real qp_kkt(qp_solver *s, tube_qp *q) {
  tube_real zero[NZ] = {0}, m, v;
  qp_state(s, q);
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
