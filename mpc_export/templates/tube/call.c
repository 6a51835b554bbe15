/* Samples since the call before: 1, more where calls did not come. Early and late calls even out. */
static int samples(tube_real passed, unsigned *said) {
  int whole;
  if (!(passed >= -1e-6 && passed <= @late@)) {
    c.phase = 0;
    *said |= @UPPER@_TUBE_CLOCK;
    return 1;
  }
  c.phase += passed / sample;
  whole = (int)(c.phase + @early@);
  if (whole < 1) whole = 1;
  c.phase = clip(c.phase - (tube_real)whole, -1, 1);
  if (whole > 1) *said |= @UPPER@_TUBE_CALLS_MISSED;
  return whole;
}

unsigned @NAME@_tube_step(tube_real passed, const tube_real y[NY], const unsigned char given[NY],
                          const @NAME@_tube_path path[N + 1], const tube_real *planes, tube_real u[NU]) {
  static const unsigned char none[NY] = {0};
  unsigned said = 0;
  int whole, due;
  if (!c.begun) {
    for (int j = 0; j < NU; j++) u[j] = clip(hover_u[j], command_min, command_max);
    return @UPPER@_TUBE_NOT_STARTED;
  }
  whole = samples(passed, &said);
  for (int k = 1; k < whole; k++) said |= seen(y, none, 0);
  said |= seen(y, given, 1);
  c.count += whole;
  due = c.count / EVERY;
  c.count %= EVERY;
  if (due) {
    tube_real wanted[NU];
    for (int k = 0; k < due && k < LAGS; k++) {
      memmove(c.past[1], c.past[0], (LAGS - 1) * sizeof c.past[0]);
      memcpy(c.past[0], c.u, sizeof c.u);
    }
    said |= decided(path, planes, due, wanted);
    for (int j = 0; j < NU; j++) {
      tube_real v = allowed(all_finite(wanted + j, 1) ? wanted[j] : c.u[j], c.u[j]);
      if (!(fabs(v - wanted[j]) <= @rounding@)) said |= @UPPER@_TUBE_BEYOND_LIMITS;
      c.u[j] = v;
    }
  }
  memcpy(u, c.u, sizeof c.u);
  return said;
}
