#include <stdint.h>
#include "@prefix@.h"

extern uint32_t data_start[], data_end[], data_load[], bss_start[], bss_end[], stack_top[];
int main(void);
void start(void);
void start(void) {
  uint32_t *to = data_start, *from = data_load;
  *(volatile uint32_t*)0xE000ED88 |= 0xFu << 20; /* the FPU on */
  __asm__ volatile ("dsb; isb");
  while (to < data_end) *to++ = *from++;
  for (to = bss_start; to < bss_end; ++to) *to = 0;
  main();
  for (;;) { }
}
static void halt(void) { for (;;) { } }
typedef void (*handler)(void);
__attribute__((section(".vectors"), used)) static const handler vectors[16] = {
  (handler)stack_top, start, halt, halt, halt, halt, halt, 0, 0, 0, 0, halt, halt, 0, halt, halt };

static int host(int operation, const void* argument) {
  register int r0 __asm__("r0") = operation;
  register const void* r1 __asm__("r1") = argument;
  __asm__ volatile ("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}
static void say(const char* word, uint32_t value) {
  char text[40];
  int n = 0, i;
  while (word[n]) { text[n] = word[n]; ++n; }
  text[n++] = ' ';
  for (i = 28; i >= 0; i -= 4) text[n++] = "0123456789abcdef"[(value >> i) & 15];
  text[n++] = '\n';
  text[n] = 0;
  host(0x04, text);
}
#define TICK ((volatile uint32_t*)0xE000E010)
static uint32_t ticks(void) { return TICK[2]; }
/* 40 ns a tick, 64 ns an instruction. */
static uint32_t instructions(uint32_t from, uint32_t to) { return (((from - to) & 0xFFFFFFu)*5u + 4u)/8u; }
#define PAINT 0xA5A5A5A5u
static void paint(void) {
  volatile uint32_t *p = bss_end, *here;
  __asm__ volatile ("mov %0, sp" : "=r"(here));
  while (p < here - 16) *p++ = PAINT;
}
static uint32_t deepest(void) {
  volatile uint32_t* p = bss_end;
  while (*p == PAINT) ++p;
  return (uint32_t)((char*)stack_top - (char*)p);
}
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
