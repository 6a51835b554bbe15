/* PX4's frames and the model's meet here and nowhere else. Both turns are by half a circle, so each is its own inverse. */
#pragma once

namespace @NAME@_frames
{
using real = @real@;

/* World: NED to ENU, or back. */
template<class From, class To> void turned_world(const From from[3], To to[3])
{
	const real x = from[0], y = from[1], z = from[2];
	to[0] = static_cast<To>(y);
	to[1] = static_cast<To>(x);
	to[2] = static_cast<To>(-z);
}

/* Body: FRD to FLU, or back. */
template<class From, class To> void turned_body(const From from[3], To to[3])
{
	const real x = from[0], y = from[1], z = from[2];
	to[0] = static_cast<To>(x);
	to[1] = static_cast<To>(-y);
	to[2] = static_cast<To>(-z);
}

/* Attitude (w, x, y, z): FRD to NED becomes FLU to ENU, or back: (0, 1, 1, 0) / sqrt(2) * q * (0, 1, 0, 0). */
template<class From, class To> void turned_attitude(const From q[4], To to[4])
{
	const real half = @root@;
	const real w = q[0], x = q[1], y = q[2], z = q[3];
	to[0] = static_cast<To>(-half * (w + z));
	to[1] = static_cast<To>(-half * (x + y));
	to[2] = static_cast<To>(half * (y - x));
	to[3] = static_cast<To>(half * (z - w));
}

/* Heading: clockwise from north becomes counter-clockwise from east, or back [rad]. */
inline real turned_heading(real psi)
{
	return @quarter@ - psi;
}
}
