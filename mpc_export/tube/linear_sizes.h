/* The limits of the QP of the linear tube */
typedef struct {
  tube_real lower[N][NU], upper[N][NU], rate_max[NU];
  tube_real most[N + 1][NL];
  tube_real penalty, penalty_square;
} tube_qp;
