/* The QP about a plan, as controller.c states it and qp_hpipm.c or qp_interior.c solves it:

     minimise   sum_k 0.5 y' H y + g' y + penalty slack + 0.5 penalty_square slack^2,     y = (d, v, w)
     subject to d+ = A d + B w + b,  v+ = w,  d_0 = v_0 = 0
                lower <= w <= upper,  |w - v + change| <= rate_max (stages 1..N-1),  G d - slack <= most (stages 1..N)

   d is the error state without disturbances, which no command moves, v the change of the previous command, w the change of
   the command. Matrices stand column by column; of A there are the nonzeros, of H those of TUBE_COST are not zero, none of
   which joins d with v or w. */
#define NZ (NK + NU)
#define NV (NK + 2 * NU)

typedef struct {
  tube_real H[N][NV * NV], g[N][NV];
  tube_real H_end[NK * NK], g_end[NK];
  tube_real A[N][TUBE_PLAN_NONZEROS], B[N][NK * NU], b[N][NK];
  tube_real lower[N][NU], upper[N][NU], change[N][NU], rate_max[NU];
  tube_real G[N + 1][NL * NK], most[N + 1][NL];
  tube_real penalty, penalty_square;
} tube_qp;

typedef struct {
  tube_real d[N + 1][NK], w[N][NU], slack[N + 1][NL];
  tube_real residual;     /* by how much dynamics and limits are missed */
  int status, iterations; /* status: 0 solved, 1 iteration limit, 2 smallest step, 3 NaN */
} tube_qp_answer;

static const int plan_column[NK + 1] = TUBE_PLAN_COLUMN, plan_row[TUBE_PLAN_NONZEROS] = TUBE_PLAN_ROW;

static const int cost_row[TUBE_COST_NONZEROS] = TUBE_COST_ROW, cost_across[TUBE_COST_NONZEROS] = TUBE_COST_ACROSS;

/* y += A x */
static void plus_sparse(const int *column, const int *row, const tube_real *a, int n, const tube_real *x, tube_real *y) {
  for (int j = 0; j < n; j++)
    for (int i = column[j]; i < column[j + 1]; i++) y[row[i]] += a[i] * x[j];
}
