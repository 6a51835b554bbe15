#pragma once
#include <atomic>
#include <cstring>

#include "defines.h"
#define PX4_INFO(...) static_cast<void>(std::snprintf(nullptr, 0, __VA_ARGS__))
#define PX4_WARN(...) PX4_INFO(__VA_ARGS__)
#define PX4_ERR(...) PX4_INFO(__VA_ARGS__)
#include <cstdio>
#define PRINT_MODULE_DESCRIPTION(text)
#define PRINT_MODULE_USAGE_NAME(name, category)
#define PRINT_MODULE_USAGE_COMMAND(name)
#define PRINT_MODULE_USAGE_DEFAULT_COMMANDS()
static constexpr int task_id_is_work_queue = -2;
inline bool stub_exits = false;
inline int stub_stop() {
  stub_exits = true;
  return 0;
}

#ifdef CRAFT_MODULE_TEMPLATE
// PX4 1.14 to 1.16
template <class T>
class ModuleBase {
 public:
  virtual ~ModuleBase() = default;
  virtual int print_status() { return 0; }
  static int main(int argc, char *argv[]) {
    if (argc > 1 && !std::strcmp(argv[1], "start")) return T::task_spawn(argc - 1, argv + 1);
    if (argc > 1 && !std::strcmp(argv[1], "stop")) return stub_stop();
    if (argc > 1 && !std::strcmp(argv[1], "status")) return _object.load()->print_status();
    return T::custom_command(argc - 1, argv + 1);
  }

 protected:
  bool should_exit() const { return stub_exits; }
  static void exit_and_cleanup() {}
  inline static std::atomic<T *> _object{nullptr};
  inline static int _task_id = -1;
};
#else
// from 1.17 on
class ModuleBase {
 public:
  struct Descriptor {
    int (*task_spawn)(int, char **);
    int (*custom_command)(int, char **);
    int (*print_usage)(const char *);
    std::atomic<ModuleBase *> object{nullptr};
    int task_id = -1;
    Descriptor(int (*spawn)(int, char **), int (*custom)(int, char **), int (*usage)(const char *))
        : task_spawn(spawn), custom_command(custom), print_usage(usage) {}
  };
  virtual ~ModuleBase() = default;
  virtual int print_status() { return 0; }
  static int main(Descriptor &desc, int argc, char *argv[]) {
    if (argc > 1 && !std::strcmp(argv[1], "start")) return desc.task_spawn(argc - 1, argv + 1);
    if (argc > 1 && !std::strcmp(argv[1], "stop")) return stub_stop();
    if (argc > 1 && !std::strcmp(argv[1], "status")) return desc.object.load()->print_status();
    return desc.custom_command(argc - 1, argv + 1);
  }

 protected:
  bool should_exit() const { return stub_exits; }
  static void exit_and_cleanup(Descriptor &) {}
};
#endif
