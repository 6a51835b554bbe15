@start@
#include "@prefix@.h"
typedef int (*function)(const @prefix@_real**, @prefix@_real**, @prefix@_int*, @prefix@_real*, int);
static int nothing(const @prefix@_real** arg, @prefix@_real** res, @prefix@_int* iw, @prefix@_real* w, int mem) {
  (void)arg; (void)res; (void)iw; (void)w;
  return mem;
}
@data@
static @prefix@_real w[@w@];
static @prefix@_int iw[@iw@];
static const @prefix@_real* arg[@arg@];
static @prefix@_real* res[@res@];
static @prefix@_real result[@result@];

static void run(function volatile f, const @prefix@_real** inputs, int n_in, const int* sizes, int n_out) {
  uint32_t from, to;
  union { @prefix@_real real; uint32_t bits; } word;
  int i, k = 0;
  for (i = 0; i < n_in; ++i) arg[i] = inputs[i];
  for (i = 0; i < n_out; ++i) { res[i] = result + k; k += sizes[i]; }
  from = ticks();
  i = f(arg, res, iw, w, 0);
  to = ticks();
  say("status", (uint32_t)i);
  say("instructions", instructions(from, to));
  for (i = 0; i < k; ++i) { word.real = result[i]; say("value", word.bits); }
}

int main(void) {
  uint32_t from, to;
  function volatile empty = nothing;
  static const uint32_t leave[2] = {0x20026, 0};
  TICK[1] = 0xFFFFFFu; TICK[2] = 0; TICK[0] = 5;
  from = ticks();
  __asm__ volatile ("mov r3, #1000\n1: subs r3, #1\n bne 1b" ::: "r3", "cc");
  to = ticks();
  say("loop", instructions(from, to)); /* 2001 instructions and those that read the clock */
  from = ticks();
  empty(arg, res, iw, w, 0);
  to = ticks();
  say("empty", instructions(from, to));
@calls@
  host(0x20, leave);
  return 0;
}
