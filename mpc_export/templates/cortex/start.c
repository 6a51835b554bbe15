#include <stdint.h>

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
/* 40 ns a tick, 2^@shift@ ns an instruction. */
static uint32_t instructions(uint32_t from, uint32_t to) {
  return (((from - to) & 0xFFFFFFu)*40u + (1u << @shift@)/2u) >> @shift@;
}
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
