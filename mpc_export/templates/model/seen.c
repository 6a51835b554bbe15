
/* Channels that an innovation is formed from, and innovations that share one. */
static const unsigned char needs[@up@_N_E][@up@_N_Y] = {
@needs@
};
static const unsigned char together[@up@_N_E][@up@_N_E] = {
@together@
};

/* Whether every measurement that counts is a number: one innovation that is missing takes those along that share a
   channel with it. */
static int finite_seen(const @real@ *y, const @real@ *there) {
  int i, k, whole;
  for (i = 0; y != 0 && there != 0 && i < @up@_N_E; ++i) {
    whole = 1;
    for (k = 0; k < @up@_N_E; ++k) whole = whole && (!together[i][k] || there[k] != 0);
    for (k = 0; whole && k < @up@_N_Y; ++k) {
      if (needs[i][k] && !finite_all(y + k, 1)) return 0;
    }
  }
  return 1;
}
