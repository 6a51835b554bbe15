#pragma once
#include <cmath>
#define PX4_OK 0
#define PX4_ERROR (-1)
#define PX4_ISFINITE(x) std::isfinite(x)
#define __EXPORT __attribute__((visibility("default")))
