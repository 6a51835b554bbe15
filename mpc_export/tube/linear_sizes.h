/* The QP of the linear tube: its matrices are those of qp_steps. */
typedef struct {
  tube_real lower[N][NU], upper[N][NU], change[N][NU], rate_max[NU];
  tube_real most[N + 1][NL];
  tube_real penalty, penalty_square;
} tube_qp;
