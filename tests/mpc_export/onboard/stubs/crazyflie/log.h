#pragma once

struct log_s {
  int type;
  const char *name;
  void *address;
};
#define LOG_UINT8 1
#define LOG_FLOAT 7
/* the firmware keeps these in a section of their own; here they are symbols that the bench can see */
#define LOG_GROUP_START(NAME) extern const struct log_s logs_##NAME[]; const struct log_s logs_##NAME[] = {
#define LOG_ADD(TYPE, NAME, ADDRESS) {.type = TYPE, .name = #NAME, .address = (void *)(ADDRESS)},
#define LOG_GROUP_STOP(NAME) {.type = 0, .name = 0, .address = 0}};
