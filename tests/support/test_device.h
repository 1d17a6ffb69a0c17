#pragma once
// The OpenCL device of the tests, opened once per process. Compiled programs go to a folder that is private to the process.

#include <unistd.h>

#include <filesystem>

#include "kernels/device/device.h"

namespace lodestone::testing {

inline Result<std::shared_ptr<Device>> open_test_device(int local_size = 64, const std::string& name = "") {
  static const bool is_prepared = [] {
    const auto folder = std::filesystem::temp_directory_path() / ("lodestone_pocl_" + std::to_string(getpid()));
    std::filesystem::create_directories(folder);
    prepare_pocl_environment(folder.string());
    static const struct Sweep {
      std::filesystem::path folder;
      ~Sweep() {
        std::error_code ignored;
        std::filesystem::remove_all(folder, ignored);
      }
    } sweep{folder};
    return true;
  }();
  (void)is_prepared;
  DeviceOptions options;
  options.local_size = local_size;
  options.name = name;
  return Device::open(options);
}

// The process-wide one with the default local size; null (and the reason on stderr) if the machine has none.
inline std::shared_ptr<Device> test_device() {
  static const std::shared_ptr<Device> device = [] {
    Result<std::shared_ptr<Device>> opened = open_test_device();
    if (!opened) fprintf(stderr, "%s\n", opened.error().message.c_str());
    return opened ? *opened : nullptr;
  }();
  return device;
}

}  // namespace lodestone::testing
