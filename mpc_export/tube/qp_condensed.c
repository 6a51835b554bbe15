/* Steps of the interior point method by condensing (Bock and Plitt 1984, IFAC Proceedings 17(2)): the states are written as
   functions of all commands once a QP, so that an iteration factorises a matrix of the commands alone. For short horizons,
   where it costs a fraction of a Riccati recursion: few commands and stages, many states. */

#include "qp_dense.c"

static const int plan_by_row[NK + 1] = TUBE_PLAN_BY_ROW, plan_row_column[TUBE_PLAN_NONZEROS] = TUBE_PLAN_ROW_COLUMN;
static const int plan_row_at[TUBE_PLAN_NONZEROS] = TUBE_PLAN_ROW_AT;

/* out = A in: NU columns, that stand row by row */
static void qp_forward(const tube_real *A, tube_real in[NK][NU], tube_real out[NK][NU]) {
  for (int i = 0; i < NK; i++) {
    tube_real sum[NU] = {0};
    for (int m = plan_by_row[i]; m < plan_by_row[i + 1]; m++) {
      const tube_real a = A[plan_row_at[m]], *x = in[plan_row_column[m]];
      for (int j = 0; j < NU; j++) sum[j] += a * x[j];
    }
    for (int j = 0; j < NU; j++) out[i][j] = sum[j];
  }
}

/* out = A' in: columns as before */
static void qp_back(const tube_real *A, tube_real in[NK][NU], tube_real out[NK][NU]) {
  for (int i = 0; i < NK; i++) {
    tube_real sum[NU] = {0};
    for (int m = plan_column[i]; m < plan_column[i + 1]; m++) {
      const tube_real a = A[m], *x = in[plan_row[m]];
      for (int j = 0; j < NU; j++) sum[j] += a * x[j];
    }
    for (int j = 0; j < NU; j++) out[i][j] = sum[j];
  }
}

/* on += the Hessian of stage k in d, times x: by its nonzeros, at the end all of it */
static void qp_curved(const tube_qp *q, int k, tube_real x[NK][NU], tube_real on[NK][NU]) {
  if (k == N) {
    for (int i = 0; i < NK; i++)
      for (int m = 0; m < NK; m++)
        for (int j = 0; j < NU; j++) on[i][j] += q->H_end[i * NK + m] * x[m][j];
    return;
  }
  for (int m = 0; m < TUBE_COST_NONZEROS; m++) {
    int r = cost_row[m], c = cost_across[m];
    if (r >= NK || c >= NK) continue;
    for (int j = 0; j < NU; j++) on[r][j] += q->H[k][c * NV + r] * x[c][j];
  }
}

/* What the command of stage j moves, its columns of C, and of H those on and below the diagonal, for d alone. */
static void qp_column(qp_steps *s, const tube_qp *q, int j) {
  tube_real next[NK][NU];
  for (int i = 0; i < NK; i++)
    for (int m = 0; m < NU; m++) s->moved[j + 1][i][m] = q->B[j][m * NK + i];
  for (int k = j + 1; k < N; k++) qp_forward(q->A[k], s->moved[k], s->moved[k + 1]);
  for (int k = j + 1; k <= N; k++)
    for (int l = 0; l < NL; l++) {
      tube_real sum[NU] = {0};
      /* zeros are not left out: with that branch GCC 12 forgets sums here (-O3 -march=znver3) */
      for (int i = 0; i < NK; i++) {
        const tube_real a = q->G[k][i * NL + l];
        for (int m = 0; m < NU; m++) sum[m] += a * s->moved[k][i][m];
      }
      for (int m = 0; m < NU; m++) s->C[(k - 1) * NL + l][j * NU + m] = sum[m];
    }
  memset(s->on, 0, sizeof s->on);
  for (int k = N; k > j; k--) {
    qp_curved(q, k, s->moved[k], s->on);
    for (int i = 0; i < NU; i++) {
      tube_real sum[NU] = {0};
      for (int r = 0; r < NK; r++) {
        tube_real b = q->B[k - 1][i * NK + r];
        for (int m = 0; m < NU; m++) sum[m] += b * s->on[r][m];
      }
      for (int m = 0; m < NU; m++) s->H[(k - 1) * NU + i][j * NU + m] = sum[m];
    }
    if (k == j + 1) break;
    qp_back(q->A[k - 1], s->on, next);
    memcpy(s->on, next, sizeof next);
  }
}

/* The gradient in the commands, and the soft limits, where no command is changed. */
static void qp_resting(qp_steps *s, const tube_qp *q) {
  static tube_real still[N][NU];
  tube_real p[NK] = {0}, on[NK];
  qp_flown(q, 0, still, s->d);
  for (int k = N; k >= 0; k--) {
    const tube_real *d = s->d[k];
    for (int l = 0; k > 0 && l < NL; l++) {
      tube_real sum = 0;
      for (int i = 0; i < NK; i++) sum += q->G[k][i * NL + l] * d[i];
      s->c[(k - 1) * NL + l] = sum;
    }
    memcpy(on, k < N ? q->g[k] : q->g_end, sizeof on);
    for (int i = 0; k == N && i < NK; i++)
      for (int m = 0; m < NK; m++) on[i] += q->H_end[i * NK + m] * d[m];
    for (int m = 0; k < N && m < TUBE_COST_NONZEROS; m++)
      if (cost_row[m] < NK && cost_across[m] < NK)
        on[cost_row[m]] += q->H[k][cost_across[m] * NV + cost_row[m]] * d[cost_across[m]];
    if (k < N) {
      for (int j = 0; j < NU; j++) {
        tube_real sum = q->g[k][NZ + j] + (k + 1 < N ? q->g[k + 1][NK + j] : 0);
        for (int i = 0; i < NK; i++) sum += q->B[k][j * NK + i] * p[i];
        s->g[k * NU + j] = sum;
      }
      for (int i = 0; k > 0 && i < NK; i++)
        for (int m = plan_column[i]; m < plan_column[i + 1]; m++) on[i] += q->A[k][m] * p[plan_row[m]];
    }
    memcpy(p, on, sizeof p);
  }
}

static void qp_prepared(qp_steps *s, const tube_qp *q) {
  for (int j = 0; j < N; j++) qp_column(s, q, j);
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++)
      for (int i = 0; i < NU; i++) {
        int at = k * NU;
        s->H[at + i][at + j] += q->H[k][(NZ + j) * NV + NZ + i] + (k + 1 < N ? q->H[k + 1][(NK + j) * NV + NK + i] : 0);
        if (k > 0) s->H[at + i][at - NU + j] += q->H[k][(NK + j) * NV + NZ + i];
      }
  for (int i = 0; i < ALL; i++)
    for (int j = 0; j < i; j++) s->H[j][i] = s->H[i][j];
  qp_resting(s, q);
}
