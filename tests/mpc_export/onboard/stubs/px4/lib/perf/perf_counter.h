#pragma once
typedef void *perf_counter_t;
enum perf_counter_type { PC_COUNT, PC_ELAPSED, PC_INTERVAL };
inline perf_counter_t perf_alloc(perf_counter_type, const char *) { return nullptr; }
inline void perf_free(perf_counter_t) {}
inline void perf_begin(perf_counter_t) {}
inline void perf_end(perf_counter_t) {}
inline void perf_print_counter(perf_counter_t) {}
