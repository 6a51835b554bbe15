
/* Channels that an innovation is formed from, and innovations that share one. */
static const unsigned char needs[@up@_N_E][@up@_N_Y] = {
@needs@
};
static const unsigned char together[@up@_N_E][@up@_N_E] = {
@together@
};

/* Whether an innovation counts: one that is missing takes those along that share a channel with it. */
static int counts(const @real@ *there, int i) {
  int k;
  for (k = 0; k < @up@_N_E; ++k) {
    if (together[i][k] && there[k] == 0) return 0;
  }
  return 1;
}

/* Whether every measurement that counts is a number. */
static int finite_seen(const @real@ *y, const @real@ *there) {
  int i, k;
  for (i = 0; y != 0 && there != 0 && i < @up@_N_E; ++i) {
    for (k = 0; counts(there, i) && k < @up@_N_Y; ++k) {
      if (needs[i][k] && !finite_all(y + k, 1)) return 0;
    }
  }
  return 1;
}

/* Whether every measurement that counts can be one: what cannot is as if it were missing, in the functions themselves. */
static int possible_seen(const @real@ *y, const @real@ *there) {
  if (y == 0 || there == 0) return 1;
@possible@  return 1;
}
