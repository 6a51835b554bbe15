/* Steps of the interior point method in the commands alone, 0.5 w' H w + g' w and C w + c for the soft limits: one Cholesky
   factor an iteration. */

enum { ALL = N * NU, ROWS = N * NL, TILE = ALL % 4 == 0 ? 4 : ALL % 2 == 0 ? 2 : 1 };

typedef struct {
  tube_real H[ALL][ALL], g[ALL];                  /* of the cost in the commands */
  tube_real C[ROWS][ALL], c[ROWS];                /* soft limits: C w + c */
  tube_real heavy[ROWS][ALL], L[ALL][ALL], inverse[ALL]; /* C with its weights; the factor, 1 / its diagonal */
  tube_real slope[ALL];
  tube_real d[N + 1][NK], moved[N + 1][NK][NU], on[NK][NU]; /* for condensing */
} qp_steps;

static tube_real qp_moves(const qp_steps *s, int k, int l) {
  const tube_real *row = s->C[(k - 1) * NL + l];
  tube_real sum = 0;
  for (int j = 0; j < k * NU; j++) sum += row[j] * row[j] / s->H[j][j];
  return sum;
}

/* Values of the soft limits, stage by stage; moved: of a change */
static void qp_soft(const qp_steps *s, const tube_qp *q, int moved, tube_real w[N][NU], qp_limits value) {
  const tube_real *flat = w[0];
  (void)q;
  for (int k = 1; k <= N; k++)
    for (int l = 0; l < NL; l++) {
      int at = (k - 1) * NL + l;
      tube_real sum = moved ? 0 : s->c[at];
      UNROLLED
      for (int j = 0; j < k * NU; j++) sum += s->C[at][j] * flat[j];
      value[k][SOFT + l] = sum;
    }
}

/* on += what numbers of the limits are in the commands */
static void qp_pushed(const qp_steps *s, qp_limits of, tube_real on[ALL]) {
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      tube_real rate = k > 0 ? of[k][RISE + j] - of[k][FALL + j] : 0;
      on[k * NU + j] += of[k][UP + j] - of[k][DOWN + j] + rate;
      if (k > 0) on[(k - 1) * NU + j] -= rate;
    }
  for (int k = 1; k <= N; k++)
    for (int l = 0; l < NL; l++) {
      const tube_real by = of[k][SOFT + l], *row = s->C[(k - 1) * NL + l];
      if (by == 0) continue;
      UNROLLED
      for (int j = 0; j < k * NU; j++) on[j] += by * row[j];
    }
}

static tube_real qp_slope(qp_steps *s, const tube_qp *q, tube_real w[N][NU], qp_limits of) {
  const tube_real *flat = w[0];
  (void)q;
  for (int i = 0; i < ALL; i++) {
    tube_real sum = s->g[i];
    UNROLLED
    for (int j = 0; j < ALL; j++) sum += s->H[i][j] * flat[j];
    s->slope[i] = sum;
  }
  qp_pushed(s, of, s->slope);
  return largest(s->slope, ALL);
}

/* A tile of the factor beside its diagonal, from its sum so far. */
static void qp_tile(qp_steps *s, int row, int column, tube_real sum[TILE][TILE]) {
  for (int j = 0; j < TILE; j++) {
    const tube_real *L = s->L[column + j] + column, inverse = s->inverse[column + j];
    for (int i = 0; i < TILE; i++) {
      for (int m = 0; m < j; m++) sum[i][j] -= sum[i][m] * L[m];
      sum[i][j] *= inverse;
      s->L[row + i][column + j] = sum[i][j];
    }
  }
}

/* One on the diagonal. Returns 1 where a pivot is not positive. */
static int qp_corner(qp_steps *s, int at, tube_real sum[TILE][TILE]) {
  for (int j = 0; j < TILE; j++)
    for (int i = j; i < TILE; i++) {
      for (int m = 0; m < j; m++) sum[i][j] -= sum[i][m] * sum[j][m];
      if (i == j) {
        if (!(sum[j][j] > 0)) return 1;
        sum[j][j] = sqrt(sum[j][j]);
        s->inverse[at + j] = 1 / sum[j][j];
      } else {
        sum[i][j] *= s->inverse[at + j];
      }
      s->L[at + i][at + j] = sum[i][j];
    }
  return 0;
}

/* L L' = H + C' W C + what limits of commands and rates weigh, tile by tile, so that a number loaded is used TILE times.
   Returns 1 where it breaks down. */
static int qp_factorised(qp_steps *s, const tube_qp *q, qp_limits weight) {
  (void)q;
  for (int i = 0; i < ALL; i++) memcpy(s->L[i], s->H[i], (size_t)(i + 1) * sizeof s->L[i][0]);
  for (int k = 0; k < N; k++)
    for (int j = 0; j < NU; j++) {
      int at = k * NU + j;
      tube_real rate = k > 0 ? weight[k][RISE + j] + weight[k][FALL + j] : 0;
      s->L[at][at] += weight[k][UP + j] + weight[k][DOWN + j] + rate;
      if (k == 0) continue;
      s->L[at - NU][at - NU] += rate;
      s->L[at][at - NU] -= rate;
    }
  for (int k = 1; k <= N; k++)
    for (int l = 0; l < NL; l++) {
      int at = (k - 1) * NL + l;
      UNROLLED
      for (int j = 0; j < k * NU; j++) s->heavy[at][j] = weight[k][SOFT + l] * s->C[at][j];
    }
  for (int i = 0; i < ALL; i += TILE)
    for (int j = 0; j <= i; j += TILE) {
      tube_real sum[TILE][TILE];
      for (int a = 0; a < TILE; a++)
        for (int b = 0; b < TILE; b++) sum[a][b] = s->L[i + a][j + b];
      for (int r = i / NU * NL; r < ROWS; r++)
        for (int a = 0; a < TILE; a++)
          for (int b = 0; b < TILE; b++) sum[a][b] += s->heavy[r][i + a] * s->C[r][j + b];
      for (int m = 0; m < j; m++)
        for (int a = 0; a < TILE; a++)
          for (int b = 0; b < TILE; b++) sum[a][b] -= s->L[i + a][m] * s->L[j + b][m];
      if (i != j)
        qp_tile(s, i, j, sum);
      else if (qp_corner(s, i, sum))
        return 1;
    }
  return 0;
}

static void qp_stepped(qp_steps *s, const tube_qp *q, qp_limits push, tube_real change[N][NU]) {
  tube_real *x = change[0];
  (void)q;
  memcpy(x, s->slope, sizeof s->slope);
  qp_pushed(s, push, x);
  for (int i = 0; i < ALL; i++) {
    tube_real sum = -x[i];
    UNROLLED
    for (int m = 0; m < i; m++) sum -= s->L[i][m] * x[m];
    x[i] = sum * s->inverse[i];
  }
  for (int i = ALL - 1; i >= 0; i--) {
    const tube_real by = x[i] *= s->inverse[i];
    UNROLLED
    for (int m = 0; m < i; m++) x[m] -= s->L[i][m] * by;
  }
}
