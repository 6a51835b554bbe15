/* @NAME@: filter, prediction and pilot of the bundle in ../../../../c, as a module on PX4's rate_ctrl queue. */
#pragma once

#include <drivers/drv_hrt.h>
#include <lib/perf/perf_counter.h>
#include <px4_platform_common/defines.h>
#include <px4_platform_common/module.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/Publication.hpp>
#include <uORB/Subscription.hpp>
#include <uORB/SubscriptionCallback.hpp>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/debug_array.h>
#include <uORB/topics/sensor_combined.h>
#include <uORB/topics/trajectory_setpoint.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_control_mode.h>
#include <uORB/topics/vehicle_local_position.h>
@battery_header@
#include "../../../../c/@NAME@_flight.h"
#include "frames.hpp"

/* The idle with which the flights of the model were read: see ../../../README.md. */
#ifndef @UPPER@_IDLE
#define @UPPER@_IDLE 0.0f
#endif

/* PX4 1.14 to 1.16 have ModuleBase<T>; from 1.17 on modules have a descriptor. */
#ifdef @UPPER@_MODULE_TEMPLATE
class @Class@ : public ModuleBase<@Class@>, public px4::ScheduledWorkItem
#else
class @Class@ : public ModuleBase, public px4::ScheduledWorkItem
#endif
{
public:
	@Class@();
	~@Class@() override;

#ifndef @UPPER@_MODULE_TEMPLATE
	static Descriptor desc;
#endif
	static int task_spawn(int argc, char *argv[]);
	static int custom_command(int argc, char *argv[]);
	static int print_usage(const char *reason = nullptr);
	bool init();
	int print_status() override;

private:
	void Run() override;
	void measure(@real@ y[@UPPER@_N_Y], unsigned char there[@UPPER@_N_Y]);
	bool commanded(hrt_abstime now);

	uORB::Subscription _attitude_sub{ORB_ID(vehicle_attitude)};
	uORB::Subscription _rate_sub{ORB_ID(vehicle_angular_velocity)};
	uORB::Subscription _imu_sub{ORB_ID(sensor_combined)};
	uORB::Subscription _place_sub{ORB_ID(vehicle_local_position)};
	uORB::Subscription _goal_sub{ORB_ID(trajectory_setpoint)};
	uORB::Subscription _mode_sub{ORB_ID(vehicle_control_mode)};
	uORB::Subscription _others_sub{ORB_ID(actuator_motors)};
@battery_member@	uORB::Publication<actuator_motors_s> _motors_pub{ORB_ID(actuator_motors)};
	uORB::Publication<debug_array_s> _predicted_pub{ORB_ID(debug_array)};

	perf_counter_t _loop_perf{perf_alloc(PC_ELAPSED, MODULE_NAME ": cycle")};
	vehicle_local_position_s _place{};
	vehicle_control_mode_s _mode{};
	@NAME@_flight _flight{};
	@real@ _aim[4]{}; /* the goal, held while no other comes */
	@real@ _others[@UPPER@_N_U]{};
	bool _begun{false};
	bool _flying{false};
};
