// Rows of PX4's numbers through a module: position and velocity NED, q FRD to NED, gyro and accelerometer FRD, setpoint NED,
// yaw, whether pose, imu and rate are new, whether it may fly, four commands of others. Prints commands and predictions, which
// are -1 where nothing was commanded. A setpoint at infinity is none; with an argument the module is stopped at the end.
#include <cmath>
#include <cstdio>

#include <drivers/drv_hrt.h>
#include <px4_platform_common/px4_work_queue/ScheduledWorkItem.hpp>
#include <uORB/Publication.hpp>
#include <uORB/topics/actuator_motors.h>
#include <uORB/topics/battery_status.h>
#include <uORB/topics/debug_array.h>
#include <uORB/topics/sensor_combined.h>
#include <uORB/topics/trajectory_setpoint.h>
#include <uORB/topics/vehicle_angular_velocity.h>
#include <uORB/topics/vehicle_attitude.h>
#include <uORB/topics/vehicle_control_mode.h>
#include <uORB/topics/vehicle_local_position.h>

static hrt_abstime now = 0;
hrt_abstime hrt_absolute_time() { return now; }
extern "C" int craft_main(int argc, char *argv[]);

template <class T>
static void say(orb_id_t topic, const T &data) {
  uORB::Publication<T>(topic).publish(data);
}

static void print() {
  uORB::Subscription motors(ORB_ID(actuator_motors)), predicted(ORB_ID(debug_array));
  actuator_motors_s out{};
  debug_array_s ahead{};
  motors.copy(&out);
  predicted.copy(&ahead);
  std::printf("%d", ahead.id);
  for (int i = 0; i < 4; ++i) std::printf(" %.9g", static_cast<double>(out.timestamp == now ? out.control[i] : -1.0f));
  for (int i = 0; i < OUTPUTS; ++i) std::printf(" %.9g", static_cast<double>(ahead.data[i]));
  std::printf("\n");
}

int main(int argc, char *[]) {
  char name[] = "craft", start[] = "start", status[] = "status", stop[] = "stop";
  char *begin[] = {name, start, nullptr}, *ask[] = {name, status, nullptr}, *end[] = {name, stop, nullptr};
  if (craft_main(2, begin) != 0) return 1;
  float v[28];
  int n = 0;
  while (std::scanf("%f", &v[n]) == 1) {
    if (++n < 28) continue;
    n = 0;
    now += px4::ScheduledWorkItem::interval;
    const bool pose = v[20] != 0, imu = v[21] != 0, rate = v[22] != 0, fly = v[23] != 0;
    if (pose) {
      vehicle_local_position_s at{};
      at.timestamp = now, at.xy_valid = at.z_valid = at.v_xy_valid = at.v_z_valid = true;
      at.x = v[0], at.y = v[1], at.z = v[2], at.vx = v[3], at.vy = v[4], at.vz = v[5], at.heading = v[19];
      say(ORB_ID(vehicle_local_position), at);
      vehicle_attitude_s turned{};
      turned.timestamp = now;
      for (int i = 0; i < 4; ++i) turned.q[i] = v[6 + i];
      say(ORB_ID(vehicle_attitude), turned);
    }
    if (imu) {
      sensor_combined_s sensors{};
      sensors.timestamp = now;
      for (int i = 0; i < 3; ++i) sensors.gyro_rad[i] = v[10 + i], sensors.accelerometer_m_s2[i] = v[13 + i];
      say(ORB_ID(sensor_combined), sensors);
    }
    if (rate) {
      vehicle_angular_velocity_s turning{};
      turning.timestamp = now;
      for (int i = 0; i < 3; ++i) turning.xyz[i] = v[10 + i];
      say(ORB_ID(vehicle_angular_velocity), turning);
    }
    vehicle_control_mode_s mode{};
    mode.flag_armed = mode.flag_control_offboard_enabled = fly;
    mode.flag_control_allocation_enabled = !fly;
    say(ORB_ID(vehicle_control_mode), mode);
    trajectory_setpoint_s goal{};
    goal.timestamp = now;
    for (int i = 0; i < 3; ++i) goal.position[i] = v[16 + i];
    goal.yaw = v[19];
    if (!std::isinf(v[16])) say(ORB_ID(trajectory_setpoint), goal);
    if (!fly) {
      actuator_motors_s others{};
      others.timestamp = now;
      for (int i = 0; i < 4; ++i) others.control[i] = v[24 + i];
      say(ORB_ID(actuator_motors), others);
    }
    px4::ScheduledWorkItem::run();
    print();
  }
  const bool asked = craft_main(2, ask) == 0;
  if (argc > 1) {
    craft_main(2, end);
    now += px4::ScheduledWorkItem::interval;
    px4::ScheduledWorkItem::run();
    print();
  }
  return n != 0 || !asked;
}
