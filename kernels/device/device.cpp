#include "kernels/device/device.h"

#include <algorithm>
#include <bit>
#include <cctype>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <map>
#include <mutex>
#include <set>
#include <utility>

#include "kernels/device/cl_handles.h"
#include "kernels/device/program_source.h"
#include "kernels/shared/ls_random.h"

namespace lodestone {

namespace {

struct Found {
  cl_device_id id;
  DeviceDescription description;
};

template <class Query>
std::string text_info(Query query) {
  std::size_t size = 0;
  if (query(0, nullptr, &size) != CL_SUCCESS || size == 0) return {};
  std::string text(size, '\0');
  if (query(size, text.data(), nullptr) != CL_SUCCESS) return {};
  text.resize(std::strlen(text.c_str()));
  return text;
}

std::string device_text(cl_device_id id, cl_device_info what) {
  return text_info([&](std::size_t n, void* p, std::size_t* size) { return clGetDeviceInfo(id, what, n, p, size); });
}

template <class T>
T device_value(cl_device_id id, cl_device_info what) {
  T value{};
  return clGetDeviceInfo(id, what, sizeof(value), &value, nullptr) == CL_SUCCESS ? value : T{};
}

DeviceDescription describe(cl_platform_id platform, cl_device_id id) {
  DeviceDescription d;
  d.platform = text_info(
      [&](std::size_t n, void* p, std::size_t* size) { return clGetPlatformInfo(platform, CL_PLATFORM_NAME, n, p, size); });
  d.name = device_text(id, CL_DEVICE_NAME);
  d.vendor = device_text(id, CL_DEVICE_VENDOR);
  d.version = device_text(id, CL_DEVICE_VERSION);
  d.driver = device_text(id, CL_DRIVER_VERSION);
  const auto type = device_value<cl_device_type>(id, CL_DEVICE_TYPE);
  d.type = (type & CL_DEVICE_TYPE_GPU) ? "gpu" : (type & CL_DEVICE_TYPE_CPU) ? "cpu" : "accelerator";
  d.compute_units = static_cast<int>(device_value<cl_uint>(id, CL_DEVICE_MAX_COMPUTE_UNITS));
  d.global_bytes = device_value<cl_ulong>(id, CL_DEVICE_GLOBAL_MEM_SIZE);
  d.max_alloc_bytes = device_value<cl_ulong>(id, CL_DEVICE_MAX_MEM_ALLOC_SIZE);
  d.max_work_group = static_cast<int>(device_value<std::size_t>(id, CL_DEVICE_MAX_WORK_GROUP_SIZE));
  return d;
}

std::vector<Found> find_devices() {
  std::vector<Found> found;
  cl_uint platforms = 0;
  if (clGetPlatformIDs(0, nullptr, &platforms) != CL_SUCCESS || platforms == 0) return found;
  std::vector<cl_platform_id> ids(platforms);
  if (clGetPlatformIDs(platforms, ids.data(), nullptr) != CL_SUCCESS) return found;
  for (const cl_platform_id platform : ids) {
    cl_uint count = 0;
    if (clGetDeviceIDs(platform, CL_DEVICE_TYPE_ALL, 0, nullptr, &count) != CL_SUCCESS || count == 0) continue;
    std::vector<cl_device_id> devices(count);
    if (clGetDeviceIDs(platform, CL_DEVICE_TYPE_ALL, count, devices.data(), nullptr) != CL_SUCCESS) continue;
    for (const cl_device_id id : devices) found.push_back({id, describe(platform, id)});
  }
  return found;
}

std::string lower(std::string text) {
  std::transform(text.begin(), text.end(), text.begin(), [](unsigned char c) { return std::tolower(c); });
  return text;
}

bool has_text(const std::string& text, const std::string& part) { return lower(text).find(lower(part)) != std::string::npos; }

std::string hex(std::uint64_t value) {
  std::string text(16, '0');
  for (int n = 15; n >= 0; --n, value >>= 4) text[static_cast<std::size_t>(n)] = "0123456789abcdef"[value & 15];
  return text;
}

// "name-device-driver-hash" in characters that any file system takes.
std::string binary_key(const ProgramSource& source, const DeviceDescription& d, const std::string& build_options) {
  std::uint64_t hash = fnv1a(source.text);
  for (const std::string& part : {build_options, d.platform, d.name, d.vendor, d.version, d.driver}) hash = fnv1a(part, fnv1a("|", hash));
  std::string key = source.name + "-" + d.name.substr(0, 40) + "-" + d.driver.substr(0, 24) + "-" + hex(hash);
  for (char& c : key)
    if (!std::isalnum(static_cast<unsigned char>(c)) && c != '.' && c != '-') c = '_';
  return key;
}

// A kept binary starts with the hash of the rest: a driver may crash on bytes that it did not write.
std::string sealed(const std::string& bytes) { return hex(fnv1a(bytes)) + bytes; }
std::string unsealed(const std::string& kept) {
  if (kept.size() <= 16) return {};
  std::string bytes = kept.substr(16);
  return hex(fnv1a(bytes)) == kept.substr(0, 16) ? bytes : std::string();
}

ClProgram from_binary(cl_context context, cl_device_id id, const std::string& bytes, const std::string& build_options) {
  if (bytes.empty()) return nullptr;
  const std::size_t size = bytes.size();
  const auto* data = reinterpret_cast<const unsigned char*>(bytes.data());
  cl_int status = CL_SUCCESS, code = CL_SUCCESS;
  ClProgram program(clCreateProgramWithBinary(context, 1, &id, &size, &data, &status, &code));
  if (code != CL_SUCCESS || status != CL_SUCCESS) return nullptr;
  if (clBuildProgram(program.get(), 1, &id, build_options.c_str(), nullptr, nullptr) != CL_SUCCESS) return nullptr;
  return program;
}

Result<ClProgram> from_source(cl_context context, cl_device_id id, const ProgramSource& source, const std::string& build_options) {
  const char* text = source.text.c_str();
  const std::size_t size = source.text.size();
  cl_int code = CL_SUCCESS;
  ClProgram program(clCreateProgramWithSource(context, 1, &text, &size, &code));
  if (code != CL_SUCCESS) return DeviceError{code, "clCreateProgramWithSource"}.to_error();
  code = clBuildProgram(program.get(), 1, &id, build_options.c_str(), nullptr, nullptr);
  if (code == CL_SUCCESS) return program;
  const std::string log = text_info([&](std::size_t n, void* p, std::size_t* got) {
    return clGetProgramBuildInfo(program.get(), id, CL_PROGRAM_BUILD_LOG, n, p, got);
  });
  return Error{ErrorCode::kDevice, "program " + source.name + " does not build (" + std::to_string(code) + ") with options \"" +
                                       build_options + "\"; the compiler says:\n" + log};
}

std::string binary_of(cl_program program) {
  std::size_t size = 0;
  if (clGetProgramInfo(program, CL_PROGRAM_BINARY_SIZES, sizeof(size), &size, nullptr) != CL_SUCCESS || size == 0) return {};
  std::string bytes(size, '\0');
  auto* data = reinterpret_cast<unsigned char*>(bytes.data());
  if (clGetProgramInfo(program, CL_PROGRAM_BINARIES, sizeof(data), &data, nullptr) != CL_SUCCESS) return {};
  return bytes;
}

class OpenDevice final : public Device {
 public:
  OpenDevice(Found found, int local_size) : description_(std::move(found.description)), id_(found.id), local_size_(local_size) {
    cl_int code = CL_SUCCESS;
    context_.reset(clCreateContext(nullptr, 1, &id_, nullptr, nullptr, &code));
    if (code != CL_SUCCESS) throw DeviceError{code, "clCreateContext"};
  }

  const DeviceDescription& description() const override { return description_; }
  _cl_context* context() const override { return context_.get(); }
  _cl_device_id* id() const override { return id_; }
  int local_size() const override { return local_size_; }
  _cl_program* program(std::string_view name) const override {
    const auto it = programs_.find(name);
    assert(it != programs_.end() && "no .cl file of that name");
    return it->second.get();
  }

  void warm_up(std::string_view name, const std::function<void()>& launch_all) override {
    const std::lock_guard lock(warm_mutex_);
    if (warm_.contains(name)) return;
    launch_all();
    warm_.emplace(name);
    const auto fresh = fresh_.find(name);
    if (fresh == fresh_.end() || !save_binary_) return;
    if (const std::string bytes = binary_of(program(name)); !bytes.empty()) save_binary_(fresh->second, sealed(bytes));
  }

  Result<void> build(const DeviceOptions& options) {
    std::string build_options = "-cl-std=CL1.2 -DLS_LOCAL_SIZE=" + std::to_string(local_size_);
    if (device_value<cl_device_fp_config>(id_, CL_DEVICE_SINGLE_FP_CONFIG) & CL_FP_CORRECTLY_ROUNDED_DIVIDE_SQRT)
      build_options += " -cl-fp32-correctly-rounded-divide-sqrt";
    save_binary_ = options.save_binary;
    for (const ProgramSource& source : program_sources()) {
      const std::string key = binary_key(source, description_, build_options);
      ClProgram program;
      if (options.load_binary) program = from_binary(context_.get(), id_, unsealed(options.load_binary(key)), build_options);
      if (!program) {
        Result<ClProgram> built = from_source(context_.get(), id_, source, build_options);
        if (!built) return std::move(built.error()).within("opening device " + description_.name);
        program = std::move(*built);
        fresh_.emplace(source.name, key);
      }
      programs_.emplace(source.name, std::move(program));
    }
    Result<void> tested;
    warm_up("selftest", [&] { tested = self_test(); });
    return tested;
  }

 private:
  // Division, square root and the Gaussian on values of all magnitudes, against the host.
  Result<void> self_test() {
    constexpr std::uint32_t kCount = 4096;
    std::vector<float> a(kCount), b(kCount);
    for (std::uint32_t n = 0; n < kCount; ++n) {
      const ls_words w = ls_philox(n, 0, 0, 0, 0x5eed, 0);
      // Finite, exponents 2^-28 .. 2^27: quotients stay normal numbers.
      a[n] = std::bit_cast<float>((w.w0 & 0x807fffffu) | ((99u + w.w2 % 56u) << 23));
      b[n] = std::bit_cast<float>((w.w1 & 0x007fffffu) | ((99u + w.w3 % 56u) << 23));
    }
    const ClQueue queue = make_queue(context_.get(), id_);
    const ClKernel kernel = make_kernel(program("selftest"), "ls_arithmetic");
    constexpr std::size_t kBytes = kCount * sizeof(float);
    const ClBuffer in_a = make_buffer(context_.get(), CL_MEM_READ_ONLY, kBytes);
    const ClBuffer in_b = make_buffer(context_.get(), CL_MEM_READ_ONLY, kBytes);
    const ClBuffer out = make_buffer(context_.get(), CL_MEM_WRITE_ONLY, 3 * kBytes);
    LS_CL(clEnqueueWriteBuffer(queue.get(), in_a.get(), CL_TRUE, 0, kBytes, a.data(), 0, nullptr, nullptr));
    LS_CL(clEnqueueWriteBuffer(queue.get(), in_b.get(), CL_TRUE, 0, kBytes, b.data(), 0, nullptr, nullptr));
    set_args(kernel.get(), in_a.get(), in_b.get(), out.get(), kCount);
    launch(queue.get(), kernel.get(), static_cast<std::size_t>(local_size_), kCount / 16, 1);
    std::vector<float> got(3 * kCount);
    LS_CL(clEnqueueReadBuffer(queue.get(), out.get(), CL_TRUE, 0, 3 * kBytes, got.data(), 0, nullptr, nullptr));
    for (std::uint32_t n = 0; n < kCount; ++n) {
      const auto bits = [](float value) { return std::bit_cast<std::uint32_t>(value); };
      const char* wrong = bits(got[n]) != bits(a[n] / b[n])                      ? "division"
                          : bits(got[kCount + n]) != bits(std::sqrt(b[n]))       ? "square root"
                          : bits(got[2 * kCount + n]) != bits(ls_gaussian(bits(a[n]), bits(b[n]), 1, 2, 3)) ? "the random generator"
                                                                                 : nullptr;
      if (wrong != nullptr)
        return Error{ErrorCode::kDevice, "device " + description_.name + ": " + wrong +
                                             " gives other bits than the host; heights would differ between machines. Use another "
                                             "device or device = \"host\""};
    }
    return {};
  }

  const DeviceDescription description_;
  cl_device_id id_;
  const int local_size_;
  ClContext context_;
  std::map<std::string, ClProgram, std::less<>> programs_;
  std::function<void(const std::string& key, const std::string& bytes)> save_binary_;
  std::map<std::string, std::string, std::less<>> fresh_;  // programs built from source -> key
  std::mutex warm_mutex_;                                  // guards the set below, and save_binary_ against concurrent calls
  std::set<std::string, std::less<>> warm_;
};

}  // namespace

std::vector<DeviceDescription> list_devices() {
  std::vector<DeviceDescription> list;
  for (Found& found : find_devices()) list.push_back(std::move(found.description));
  return list;
}

void prepare_pocl_environment(const std::string& cache_dir) {
  setenv("POCL_DEVICES", "basic", 0);
  setenv("POCL_CACHE_DIR", cache_dir.c_str(), 0);
  setenv("POCL_SIGFPE_HANDLER", "0", 0);
}

Result<std::shared_ptr<Device>> Device::open(const DeviceOptions& options) {
  if (options.local_size < 1 || options.local_size > 4096)
    return Error{ErrorCode::kInvalidArgument, "device local size must be 1..4096, found " + std::to_string(options.local_size)};
  std::string existing;
  int matches = 0;
  for (Found& found : find_devices()) {
    const DeviceDescription& d = found.description;
    existing += (existing.empty() ? "" : "; ") + d.platform + ": " + d.name;
    if (!has_text(d.platform, options.platform) || !has_text(d.name, options.name) || matches++ != options.index) continue;
    if (options.local_size > d.max_work_group)
      return Error{ErrorCode::kInvalidArgument, "device " + d.name + " takes at most " + std::to_string(d.max_work_group) +
                                                    " work-items per group, local size is " + std::to_string(options.local_size)};
    try {
      auto device = std::make_shared<OpenDevice>(std::move(found), options.local_size);
      if (Result<void> built = device->build(options); !built) return std::move(built.error());
      return std::shared_ptr<Device>(std::move(device));
    } catch (const DeviceError& error) {
      return error.to_error().within("opening an OpenCL device");
    }
  }
  return Error{ErrorCode::kNotFound, "no OpenCL device number " + std::to_string(options.index) + " with platform \"" +
                                         options.platform + "\" and name \"" + options.name + "\"; there is " +
                                         (existing.empty() ? "none at all (install pocl-opencl-icd, or use device = \"host\")" : existing)};
}

}  // namespace lodestone
