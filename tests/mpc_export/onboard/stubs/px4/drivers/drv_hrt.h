// What a module sees of PX4, written from its published interface.
#pragma once
#include <cstdint>
typedef uint64_t hrt_abstime;
hrt_abstime hrt_absolute_time();
