/* Random numbers of the fuzz programs, put in front of them; `state_of_rng` is the seed, not zero. */

#include <math.h>
#include <stdint.h>

static uint64_t state_of_rng;

static double uniform(void) { /* xorshift64*, Vigna 2016 */
  state_of_rng ^= state_of_rng >> 12;
  state_of_rng ^= state_of_rng << 25;
  state_of_rng ^= state_of_rng >> 27;
  return (double)((state_of_rng * UINT64_C(2685821657736338717)) >> 11) / 9007199254740992.0;
}

static int drawn(int n) { return (int)(uniform() * n) % n; }

static double signed_power(double low, double high) {
  return (uniform() < 0.5 ? -1 : 1) * pow(10.0, low + (high - low) * uniform());
}
