#include "@Class@.hpp"

#include <math.h>

using @NAME@_frames::turned_attitude;
using @NAME@_frames::turned_body;
using @NAME@_frames::turned_heading;
using @NAME@_frames::turned_world;

#ifndef @UPPER@_MODULE_TEMPLATE
ModuleBase::Descriptor @Class@::desc{task_spawn, custom_command, print_usage};
#endif

@Class@::@Class@() :
	ScheduledWorkItem(MODULE_NAME, px4::wq_configurations::rate_ctrl)
{
}

@Class@::~@Class@()
{
	perf_free(_loop_perf);
}

bool @Class@::init()
{
	ScheduleOnInterval(@micros@); /* [us]: the model's sample time */
	return true;
}

/* Columns of the model from PX4's topics: what is new since the last sample, and valid, is there. */
void @Class@::measure(@real@ y[@UPPER@_N_Y], unsigned char there[@UPPER@_N_Y])
{
	@real@ place[3]{}, speed[3]{}, q[4]{}, rate[3]{}, force[3]{};
	bool seen_place = false, seen_speed = false, seen_q = false, seen_rate = false, seen_force = false;

	if (_place_sub.update(&_place)) {
		const float at[3] = {_place.x, _place.y, _place.z};
		const float moves[3] = {_place.vx, _place.vy, _place.vz};
		turned_world(at, place);
		turned_world(moves, speed);
		seen_place = _place.xy_valid && _place.z_valid;
		seen_speed = _place.v_xy_valid && _place.v_z_valid;
	}

	vehicle_attitude_s attitude{};

	if (_attitude_sub.update(&attitude)) {
		turned_attitude(attitude.q, q);
		seen_q = true;
	}

	sensor_combined_s imu{};
	vehicle_angular_velocity_s turning{};
	const bool turned = _rate_sub.update(&turning);

	if (_imu_sub.update(&imu)) {
		turned_body(imu.gyro_rad, rate);
		turned_body(imu.accelerometer_m_s2, force);
		seen_rate = true;
		seen_force = imu.accelerometer_timestamp_relative != sensor_combined_s::RELATIVE_TIMESTAMP_INVALID;

	} else if (turned) {
		turned_body(turning.xyz, rate);
		seen_rate = true;
	}

	for (int i = 0; i < @UPPER@_N_Y; ++i) {
		y[i] = 0;
		there[i] = 0;
	}

	(void)seen_place;
	(void)seen_speed;
	(void)seen_q;
	(void)seen_force;
@measured@
}

/* The motor signal at a control of zero; the model's command is idle + (1 - idle) control. */
static constexpr float idle = @UPPER@_IDLE;
static_assert(idle >= 0.0f && idle < 1.0f, "@UPPER@_IDLE is a share of the full motor signal");

/* The control that gives a command; one below the idle is the idle, and the filter is to know that. */
static float control_of(@real@ &u)
{
	constexpr @real@ least = idle;

	if (u < least) {
		u = least;
	}

	const float control = (static_cast<float>(u) - idle) / (1.0f - idle);
	return control < 0.0f ? 0.0f : control > 1.0f ? 1.0f : control;
}

/* Whether PX4 leaves the motors to whoever publishes them, and, to take over, where to: offboard, direct actuator control.
   Who flies goes on while nobody else does: a goal that is not finite or too old leaves the last. */
bool @Class@::commanded(hrt_abstime now)
{
	constexpr hrt_abstime oldest = 500000; /* [us] */
	trajectory_setpoint_s goal{};
	_mode_sub.update(&_mode);

	if (!_mode.flag_armed || _mode.flag_control_allocation_enabled) {
		return false;
	}

	/* NaN: not to be controlled */
	if (_goal_sub.copy(&goal) && goal.timestamp != 0 && now < goal.timestamp + oldest
	    && PX4_ISFINITE(goal.position[0] + goal.position[1] + goal.position[2] + goal.yaw)) {
		turned_world(goal.position, _aim);
		_aim[3] = turned_heading(goal.yaw);
		return _flying || _mode.flag_control_offboard_enabled;
	}

	return _flying;
}

void @Class@::Run()
{
	if (should_exit()) {
		ScheduleClear();

		if (_flying) {
			/* nobody else commands: NaN stops a motor */
			actuator_motors_s stopped{};
			stopped.timestamp = stopped.timestamp_sample = hrt_absolute_time();

			for (float &control : stopped.control) {
				control = NAN;
			}

			_motors_pub.publish(stopped);
		}

#ifdef @UPPER@_MODULE_TEMPLATE
		exit_and_cleanup();
#else
		exit_and_cleanup(desc);
#endif
		return;
	}

	perf_begin(_loop_perf);
	@real@ y[@UPPER@_N_Y];
	unsigned char there[@UPPER@_N_Y];
	measure(y, there);

	if (!_begun) {
		const float at[3] = {_place.x, _place.y, _place.z};
		@real@ place[4] {};
		turned_world(at, place);
		place[3] = turned_heading(_place.heading);

		if (!_place.xy_valid || !_place.z_valid || !@NAME@_flight_start(&_flight, place)) {
			perf_end(_loop_perf);
			return;
		}

		for (int i = 0; i < @UPPER@_N_U; ++i) {
			_others[i] = _flight.u[i];
		}

		_begun = true;
	}

	const hrt_abstime now = hrt_absolute_time();
	const bool flying = commanded(now);
	_flying = flying;
@battery@
	if (flying) {
		/* what the sample before decided comes into force now */
		actuator_motors_s motors{};
		motors.timestamp = now;
		motors.timestamp_sample = now;

		for (int i = 0; i < actuator_motors_s::NUM_CONTROLS; ++i) {
			motors.control[i] = i < @UPPER@_N_U ? control_of(_flight.u[i]) : NAN;
		}

		_motors_pub.publish(motors);
		@NAME@_flight_sample(&_flight, y, there, _aim);

	} else {
		actuator_motors_s others{};

		if (_others_sub.update(&others)) {
			bool runs = false; /* all at zero are stopped */

			for (int i = 0; i < @UPPER@_N_U; ++i) {
				runs = runs || others.control[i] > 0.0f;
			}

			for (int i = 0; i < @UPPER@_N_U; ++i) {
				const float control = others.control[i];
				const float signal = runs && control >= 0.0f ? idle + (1.0f - idle) * control : control;
				/* NaN is a motor that is stopped */
				_others[i] = PX4_ISFINITE(control) ? signal : 0;
			}
		}

		@NAME@_flight_watch(&_flight, y, there, _others);
	}

	debug_array_s predicted{};
	predicted.timestamp = now;
	predicted.id = static_cast<uint16_t>(_flight.code + 256 * _flight.said);

	for (int i = 0; i < @UPPER@_N_Y && i < debug_array_s::ARRAY_SIZE; ++i) {
		predicted.data[i] = static_cast<float>(_flight.y_hat[i]);
	}

	_predicted_pub.publish(predicted);
	perf_end(_loop_perf);
}

int @Class@::task_spawn(int /* argc */, char * /* argv */[])
{
	@Class@ *instance = new @Class@();

#ifdef @UPPER@_MODULE_TEMPLATE
	auto &object = _object;
	auto &task = _task_id;
#else
	auto &object = desc.object;
	auto &task = desc.task_id;
#endif

	if (instance != nullptr) {
		object.store(instance);
		task = task_id_is_work_queue;

		if (instance->init()) {
			return PX4_OK;
		}

	} else {
		PX4_ERR("alloc failed");
	}

	delete instance;
	object.store(nullptr);
	task = -1;
	return PX4_ERROR;
}

int @Class@::print_status()
{
	PX4_INFO("%s, %lu samples failed, %lu refused, last code %d, said %d", _flying ? "flies" : "watches",
		 _flight.failures, _flight.refused, _flight.code, _flight.said);
	perf_print_counter(_loop_perf);
	return 0;
}

int @Class@::custom_command(int /* argc */, char * /* argv */[])
{
	return print_usage("unknown command");
}

int @Class@::print_usage(const char *reason)
{
	if (reason != nullptr) {
		PX4_WARN("%s", reason);
	}

	PRINT_MODULE_DESCRIPTION("Filter, prediction and pilot of an identified model.");
	PRINT_MODULE_USAGE_NAME("@NAME@", "controller");
	PRINT_MODULE_USAGE_COMMAND("start");
	PRINT_MODULE_USAGE_DEFAULT_COMMANDS();
	return 0;
}

extern "C" __EXPORT int @NAME@_main(int argc, char *argv[])
{
#ifdef @UPPER@_MODULE_TEMPLATE
	return @Class@::main(argc, argv);
#else
	return ModuleBase::main(@Class@::desc, argc, argv);
#endif
}
