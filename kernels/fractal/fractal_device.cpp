// The OpenCL version: every operation of the plan is one launch on an in-order queue.

#include <algorithm>
#include <cstring>
#include <string>

#include "kernels/device/cl_handles.h"
#include "kernels/fractal/fractal_plan.h"
#include "kernels/fractal/fractal_synthesis.h"

namespace lodestone {
namespace {

class DeviceFractalSynthesis final : public FractalSynthesis {
 public:
  explicit DeviceFractalSynthesis(std::shared_ptr<Device> device)
      : device_(std::move(device)), queue_(make_queue(device_->context(), device_->id())) {
    for (std::size_t n = 0; n < kKernelCount; ++n)
      kernels_[n] = make_kernel(device_->program("fractal"), kernel_name(static_cast<FractalKernel>(n)));
    device_->warm_up("fractal", [this] { run_small_tiles(); });
  }

  Result<void> run(std::span<const FractalTask> tasks, std::span<std::vector<float>> heights_m) override {
    for (std::size_t n = 0; n < tasks.size(); ++n) {
      if (Result<void> ok = check(tasks[n]); !ok)
        return std::move(ok.error()).within("task " + std::to_string(n));
      try {
        run_one(tasks[n], heights_m[n]);
      } catch (const DeviceError& error) {
        return error.to_error().within("fractal synthesis of task " + std::to_string(n));
      }
    }
    return {};
  }

 private:
  // Launches every kernel once: PoCL compiles a kernel at its first launch, which must not happen in a request.
  void run_small_tiles() {
    // Every size of launch, by one thread: see the wavelet's.
    for (const int posts : {17, 257}) run_small_tiles(posts);
  }

  void run_small_tiles(int posts) {
    FractalTask task;
    task.world = {0, 0, 64, 64};
    task.depth = 2;
    task.posts = posts;
    std::vector<float> heights_m;
    for (const FractalMethod method :
         {FractalMethod::kSquareSquare, FractalMethod::kDiamondSquare, FractalMethod::kFractalWavelet}) {
      for (const bool has_rules : {false, true}) {
        for (const bool has_mask : {false, true}) {
          task.method = method;
          task.x0 = task.y0 = has_rules ? 96 : 0;  // inside and at the border
          task.parameters.erosion = has_rules;
          if (has_rules) task.parameters.altitude = AltitudeRule{};
          const PostWindow coarse = coarse_window(task);
          task.coarse_m.assign(static_cast<std::size_t>(coarse.width() * coarse.height()), 1.0F);
          const PostWindow nodes = node_window(task, 4);
          const PostWindow all = layer_nodes(task.world, 4);
          task.nodes = {4, nodes.i0, nodes.j0, static_cast<int>(nodes.width()), static_cast<int>(nodes.height()), all.width(), all.height(), {}};
          task.nodes.nodes.assign(static_cast<std::size_t>(nodes.width() * nodes.height()), {1.0F, 0.8F});
          task.mask.reset();
          if (has_mask) {
            const PostWindow pixels = mask_window(task, 0);
            task.mask = MaskCrop{0, pixels.i0, pixels.j0, static_cast<int>(pixels.width()), static_cast<int>(pixels.height()), {}};
            task.mask->pixels.assign(static_cast<std::size_t>(pixels.width() * pixels.height()), 100);
          }
          run_one(task, heights_m);
        }
      }
      task.parameters = {};
    }
  }

  void run_one(const FractalTask& task, std::vector<float>& heights_m) {
    const FractalPlan plan = make_plan(task);
    for (std::size_t slot = 0; slot < kSlotCount; ++slot)
      need(static_cast<FractalSlot>(slot), plan.floats[slot]);
    fill(kSlotHeightsA, plan.heights);
    fill(kSlotTable, plan.table);
    fill(kSlotKeep, plan.keep);
    for (const FractalOp& op : plan.ops) enqueue(op);

    const std::size_t posts = static_cast<std::size_t>(task.posts);
    const std::size_t last = LS_FRACTAL_GUARD + plan.out_at + (posts - 1) * plan.out_pitch + posts;
    heights_m.resize(posts * posts);
    Mapped mapped(queue_.get(), planes_[plan.out].get(), CL_MAP_READ, last * sizeof(float));
    const float* from = static_cast<const float*>(mapped.data()) + LS_FRACTAL_GUARD + plan.out_at;
    for (std::size_t j = 0; j < posts; ++j)
      std::copy(from + j * plan.out_pitch, from + j * plan.out_pitch + posts,
                heights_m.begin() + static_cast<std::ptrdiff_t>(j * posts));
    mapped.release();
  }

  // Planes grow and are zeroed once: what lies outside the needed values is finite from the start.
  void need(FractalSlot slot, std::size_t floats) {
    const std::size_t size = floats + 2 * LS_FRACTAL_GUARD;
    if (floats == 0 || sizes_[slot] >= size) return;
    sizes_[slot] = 0;
    planes_[slot] =
        make_buffer(device_->context(), CL_MEM_READ_WRITE | CL_MEM_ALLOC_HOST_PTR, size * sizeof(float));
    sizes_[slot] = size;
    const float zero = 0;
    LS_CL(clEnqueueFillBuffer(queue_.get(), planes_[slot].get(), &zero, sizeof(zero), 0, size * sizeof(float),
                              0, nullptr, nullptr));
  }

  void fill(FractalSlot slot, const std::vector<float>& values) {
    if (values.empty()) return;
    const std::size_t bytes = values.size() * sizeof(float);
    Mapped mapped(queue_.get(), planes_[slot].get(), CL_MAP_WRITE, LS_FRACTAL_GUARD * sizeof(float) + bytes);
    std::memcpy(static_cast<float*>(mapped.data()) + LS_FRACTAL_GUARD, values.data(), bytes);
    mapped.release();
  }

  void enqueue(const FractalOp& op) {
    cl_kernel kernel = kernels_[op.kernel].get();
    LS_CL(clSetKernelArg(kernel, 0, sizeof(op.step), &op.step));
    for (int n = 0; n < op.slot_count; ++n) {
      cl_mem plane = planes_[op.slots[static_cast<std::size_t>(n)]].get();
      LS_CL(clSetKernelArg(kernel, static_cast<cl_uint>(n + 1), sizeof(plane), &plane));
    }
    // Wide kernels take all rows as one.
    const bool is_wide = is_sixteen_wide(op.kernel);
    const std::size_t columns = static_cast<std::size_t>(is_wide ? (op.columns + 15) / 16 * op.rows : op.columns);
    launch(queue_.get(), kernel, static_cast<std::size_t>(device_->local_size()), columns,
           is_wide ? 1 : static_cast<std::size_t>(op.rows));
  }

  const std::shared_ptr<Device> device_;
  ClQueue queue_;
  std::array<ClKernel, kKernelCount> kernels_;
  std::array<ClBuffer, kSlotCount> planes_;
  std::array<std::size_t, kSlotCount> sizes_{};
};

}  // namespace

Result<std::unique_ptr<FractalSynthesis>> make_device_fractal_synthesis(std::shared_ptr<Device> device) {
  try {
    return std::unique_ptr<FractalSynthesis>(std::make_unique<DeviceFractalSynthesis>(std::move(device)));
  } catch (const DeviceError& error) {
    return error.to_error().within("preparing fractal synthesis");
  }
}

}  // namespace lodestone
