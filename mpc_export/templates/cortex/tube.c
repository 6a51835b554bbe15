@start@
#include "@NAME@_tube.h"

#define SAMPLES @samples@
#define NY @UPPER@_TUBE_N_Y
#define NU @UPPER@_TUBE_N_U
static const float measured[SAMPLES][NY] = {
@measured@
};
static const @NAME@_tube_path path[SAMPLES][@UPPER@_TUBE_STAGES + 1] = {
@path@
};
static const float planes[] = {@planes@};

int main(void) {
  static const float place[4] = {@place@};
  static const uint32_t leave[2] = {0x20026, 0};
  union { float real; uint32_t bits; } word;
  float u[NU];
  int i, k;
  TICK[1] = 0xFFFFFFu; TICK[2] = 0; TICK[0] = 5;
  @NAME@_tube_start(place);
  paint();
  for (k = 0; k < SAMPLES; ++k) {
    unsigned char given[NY];
    uint32_t from, to, said;
    for (i = 0; i < NY; ++i) given[i] = measured[k][i] == measured[k][i];
    from = ticks();
    said = @NAME@_tube_step(@dt@, measured[k], given, path[k], planes, u);
    to = ticks();
    say("instructions", instructions(from, to));
    say("said", said);
    for (i = 0; i < NU; ++i) { word.real = u[i]; say("u", word.bits); }
  }
  say("stack", deepest());
  host(0x20, leave);
  return 0;
}
