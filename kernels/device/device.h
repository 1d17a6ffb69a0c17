#pragma once
// Device: one OpenCL device with its context and the programs that were built for it at start.
// Handles are shared by worker threads; queues and cl_kernels are per thread (clSetKernelArg is not thread-safe).

#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/types/result.h"

struct _cl_context;
struct _cl_device_id;
struct _cl_program;
struct _cl_command_queue;
struct _cl_kernel;

namespace lodestone {

// One line of `lodestone devices`.
struct DeviceDescription {
  std::string platform, name, vendor, version, driver, type;  // type: "cpu", "gpu", "accelerator"
  int compute_units = 0;
  std::uint64_t global_bytes = 0;
  std::uint64_t max_alloc_bytes = 0;
  int max_work_group = 0;
};

struct DeviceOptions {
  std::string platform;      // substring of the platform's name, case-insensitive; empty = any
  std::string name;          // substring of the device's name; empty = any
  int index = 0;             // among those that match
  int local_size = 64;       // work-items per group for the kernels; results do not depend on it
  // Compiled programs are kept by the caller: `load_binary(key)` gives the bytes or an empty string, `save_binary(key, bytes)`
  // stores them, once per program after its warm_up() (drivers compile at the first launch). The key names device, driver and
  // source hash. Either may be empty. A bad binary falls back to the source. Both may be called from any thread, one at a time.
  std::function<std::string(const std::string& key)> load_binary;
  std::function<void(const std::string& key, const std::string& bytes)> save_binary;
};

// All OpenCL devices of the machine; empty when there is no ICD or no device.
std::vector<DeviceDescription> list_devices();

// Sets the PoCL environment for this process: device `basic`, private cache folder, no SIGFPE handler. Values that the
// user has set stay. Must run before the first OpenCL call.
void prepare_pocl_environment(const std::string& cache_dir);

class Device {
 public:
  // Opens the device, builds every program and runs the arithmetic self-test (Gaussian vectors, division and sqrt bits
  // against the host). Errors: kNotFound (no device matches; lists those that exist), kDevice (build log inside).
  static Result<std::shared_ptr<Device>> open(const DeviceOptions& options);
  virtual ~Device() = default;

  virtual const DeviceDescription& description() const = 0;
  virtual _cl_context* context() const = 0;
  virtual _cl_device_id* id() const = 0;
  virtual int local_size() const = 0;
  // The built program `name` (stem of a .cl file, e.g. "wavelet"). Asserts that it exists.
  virtual _cl_program* program(std::string_view name) const = 0;
  // Runs `launch_all` once per device and program name (other callers wait for it). It launches every kernel of that program, so
  // that nothing is left to compile for the first request; then the program, if it came from source, is given to save_binary.
  // May throw what launch_all throws; the next caller tries again.
  virtual void warm_up(std::string_view program, const std::function<void()>& launch_all) = 0;
};

// FNV-1a of the text of all kernels and shared headers: part of the revision of every synthetic tile.
std::uint64_t kernel_source_hash();

}  // namespace lodestone
