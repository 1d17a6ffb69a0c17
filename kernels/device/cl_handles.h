#pragma once
// Owners of OpenCL handles and the check of every call. Only .cpp files of the kernels room include this.

#define CL_USE_DEPRECATED_OPENCL_1_2_APIS
#include <CL/cl.h>

#include <functional>
#include <memory>
#include <mutex>
#include <string>
#include <unordered_set>
#include <utility>

#include "kernels/types/result.h"

namespace lodestone {

// Thrown by LS_CL inside the room; its front doors turn it into Error{kDevice}.
struct DeviceError {
  cl_int code;
  const char* call;
  Error to_error() const {
    return {ErrorCode::kDevice, "OpenCL returned " + std::to_string(code) + " from " + call};
  }
};
#define LS_CL(call)                                                                    \
  do {                                                                                 \
    if (const cl_int code_ = (call); code_ != CL_SUCCESS) throw ::lodestone::DeviceError{code_, #call}; \
  } while (0)

template <auto Release>
struct ClCloser {
  template <class Handle>
  void operator()(Handle* handle) const noexcept {
    Release(handle);
  }
};
using ClContext = std::unique_ptr<_cl_context, ClCloser<clReleaseContext>>;
using ClProgram = std::unique_ptr<_cl_program, ClCloser<clReleaseProgram>>;
using ClQueue = std::unique_ptr<_cl_command_queue, ClCloser<clReleaseCommandQueue>>;
using ClKernel = std::unique_ptr<_cl_kernel, ClCloser<clReleaseKernel>>;
using ClBuffer = std::unique_ptr<_cl_mem, ClCloser<clReleaseMemObject>>;

inline ClQueue make_queue(cl_context context, cl_device_id id) {
  cl_int code = CL_SUCCESS;
  ClQueue queue(clCreateCommandQueue(context, id, 0, &code));
  if (code != CL_SUCCESS) throw DeviceError{code, "clCreateCommandQueue"};
  return queue;
}

inline ClKernel make_kernel(cl_program program, const char* name) {
  cl_int code = CL_SUCCESS;
  ClKernel kernel(clCreateKernel(program, name, &code));
  if (code != CL_SUCCESS) throw DeviceError{code, name};
  return kernel;
}

// Host-visible memory: reached through map and unmap, which cost nothing on a CPU device.
inline ClBuffer make_buffer(cl_context context, cl_mem_flags flags, std::size_t bytes) {
  cl_int code = CL_SUCCESS;
  ClBuffer buffer(clCreateBuffer(context, flags, bytes, nullptr, &code));
  if (code != CL_SUCCESS) throw DeviceError{code, "clCreateBuffer"};
  return buffer;
}

// A device buffer that grows by need. `host` keeps it host-visible.
class GrowingBuffer {
 public:
  explicit GrowingBuffer(bool host) : flags_(CL_MEM_READ_WRITE | (host ? CL_MEM_ALLOC_HOST_PTR : 0)) {}
  // At least `bytes`; old contents are lost when it grows.
  cl_mem need(cl_context context, std::size_t bytes) {
    if (bytes > size_ || !buffer_) {
      buffer_.reset();
      size_ = 0;
      const std::size_t wanted = bytes + bytes / 4 + 4096;
      buffer_ = make_buffer(context, flags_, wanted);
      size_ = wanted;
    }
    return buffer_.get();
  }
  cl_mem get() const { return buffer_.get(); }

 private:
  cl_mem_flags flags_;
  ClBuffer buffer_;
  std::size_t size_ = 0;
};

// A mapped range of a buffer; unmapped by release() (checked) or, on an error path, by the destructor.
class Mapped {
 public:
  Mapped(cl_command_queue queue, cl_mem buffer, cl_map_flags flags, std::size_t bytes) : queue_(queue), buffer_(buffer) {
    cl_int code = CL_SUCCESS;
    data_ = clEnqueueMapBuffer(queue, buffer, CL_TRUE, flags, 0, bytes, 0, nullptr, nullptr, &code);
    if (code != CL_SUCCESS) throw DeviceError{code, "clEnqueueMapBuffer"};
  }
  Mapped(const Mapped&) = delete;
  Mapped& operator=(const Mapped&) = delete;
  ~Mapped() {
    if (data_ != nullptr) clEnqueueUnmapMemObject(queue_, buffer_, data_, 0, nullptr, nullptr);
  }
  void* data() const { return data_; }
  void release() {
    void* data = std::exchange(data_, nullptr);
    LS_CL(clEnqueueUnmapMemObject(queue_, buffer_, data, 0, nullptr, nullptr));
  }

 private:
  cl_command_queue queue_;
  cl_mem buffer_;
  void* data_ = nullptr;
};

// clSetKernelArg for each argument in turn.
template <class... Args>
void set_args(cl_kernel kernel, const Args&... args) {
  cl_uint n = 0;
  const auto set = [&](const auto& value) { LS_CL(clSetKernelArg(kernel, n++, sizeof(value), &value)); };
  (set(args), ...);
}

// One launch of groups of local_size work-items: `items` in x (rounded up), `rows` in y.
inline void launch(cl_command_queue queue, cl_kernel kernel, std::size_t local_size, std::size_t items, std::size_t rows) {
  const std::size_t global[2] = {(items + local_size - 1) / local_size * local_size, rows};
  const std::size_t local[2] = {local_size, 1};
  // PoCL's table of compiled kernels breaks (an assertion ends the process) when two threads are the first to launch the same
  // variant of a kernel; variants depend on the sizes. So the first launch of a kernel at a size has the process to itself.
  static std::mutex mutex;
  static std::unordered_set<std::size_t> met;  // guarded by mutex
  thread_local std::unordered_set<std::size_t> met_here;
  char name[64] = {};
  LS_CL(clGetKernelInfo(kernel, CL_KERNEL_FUNCTION_NAME, sizeof name, name, nullptr));
  const std::size_t variant = std::hash<std::string>()(std::string(name) + '/' + std::to_string(global[0]) + '/' +
                                                       std::to_string(rows) + '/' + std::to_string(local_size));
  const auto enqueue = [&] { LS_CL(clEnqueueNDRangeKernel(queue, kernel, 2, nullptr, global, local, 0, nullptr, nullptr)); };
  if (met_here.contains(variant)) return enqueue();
  {
    const std::lock_guard lock(mutex);
    if (met.insert(variant).second) {
      enqueue();
      LS_CL(clFinish(queue));
      met_here.insert(variant);
      return;
    }
  }
  met_here.insert(variant);
  enqueue();
}

}  // namespace lodestone
