// Launcher of wavelet_details.cl and lifting.cl: batches tasks of equal shape, packs their plans into one parameter buffer.

#include <algorithm>
#include <bit>
#include <cstring>

#include "kernels/device/cl_handles.h"
#include "kernels/shared/ls_wavelet.h"
#include "kernels/synthesis/wavelet_plan.h"
#include "kernels/synthesis/wavelet_synthesis.h"

namespace lodestone {

namespace {

// A block of 16 may be read or written past the last row.
constexpr std::size_t kSlack = 64;
// Working set of one chunk of tiles. CPU: about the second-level cache, beyond which batches lose more than launches cost.
constexpr std::size_t kCpuChunkBytes = std::size_t{3} << 19;
constexpr std::size_t kGpuChunkBytes = std::size_t{64} << 20;

// Sizes that all tiles of a batch have in common, counted in floats; places are relative to the tile's share of a buffer.
struct LevelShape {
  int posts = 0, columns = 0, lead = 0, stride = 0;
  std::size_t plane = 0, detail_at = 0;
  int made = 0;  // fine posts per edge
  std::size_t out_at = 0, out_stride = 0;
};
struct BatchShape {
  WaveletBasis basis{};
  std::vector<LevelShape> levels;
  std::size_t coarse = 0, detail = 0, heights = 0, out = 0, lines = 0;  // per tile
  std::size_t bytes() const { return 4 * (coarse + detail + heights + out + lines); }
};

std::size_t area(std::size_t a, std::size_t b) { return a * b; }

BatchShape shape_of(const WaveletTask& task, const WaveletPlan& plan) {
  BatchShape shape;
  shape.basis = task.basis;
  const bool is_22 = task.basis == WaveletBasis::kCdf22;
  shape.coarse = task.coarse_m.size();
  for (std::size_t s = 0; s < plan.levels.size(); ++s) {
    const LevelPlan& from = plan.levels[s];
    LevelShape to{from.posts, from.columns, from.lead, from.stride};
    to.plane = (area(static_cast<std::size_t>(to.stride), static_cast<std::size_t>(to.columns)) + kSlack + 15) / 16 * 16;
    to.detail_at = shape.detail;
    shape.detail += 3 * to.plane;
    to.made = is_22 ? 2 * from.posts - 1 : 2 * from.posts - 5;
    // Blocks of ls_inverse22 write 33 columns at least; a full-size last level is packed, so that it is read back in one go.
    const bool is_last = s + 1 == plan.levels.size();
    const auto made = static_cast<std::size_t>(to.made);
    to.out_stride = is_last && is_22 && made >= 33 && to.made == task.posts ? made : std::max<std::size_t>((made + 15) / 16 * 16, 48);
    std::size_t& total = is_last ? shape.out : shape.heights;
    to.out_at = total;
    total += (area(to.out_stride, made) + kSlack + 15) / 16 * 16;
    if (!is_22) shape.lines = std::max(shape.lines, area(made, static_cast<std::size_t>(to.posts + to.stride)) + kSlack);
    shape.levels.push_back(to);
  }
  return shape;
}

bool same_shape(const WaveletTask& a, const WaveletTask& b) { return a.depth == b.depth && a.posts == b.posts && a.basis == b.basis; }

class DeviceSynthesis final : public WaveletSynthesis {
 public:
  explicit DeviceSynthesis(std::shared_ptr<Device> device)
      : device_(std::move(device)),
        context_(device_->context()),
        local_(static_cast<std::size_t>(device_->local_size())),
        chunk_bytes_(device_->description().type == "cpu" ? kCpuChunkBytes : kGpuChunkBytes),
        strip_(device_->description().type == "cpu" ? 16 : 1),
        queue_(make_queue(context_, device_->id())),
        sigma_rows_(make_kernel(device_->program("wavelet_details"), "ls_sigma_rows")),
        mask_rows_(make_kernel(device_->program("wavelet_details"), "ls_mask_rows")),
        details_(make_kernel(device_->program("wavelet_details"), "ls_details")),
        inverse22_(make_kernel(device_->program("lifting"), "ls_inverse22")),
        inverse44_(make_kernel(device_->program("lifting"), "ls_inverse44")) {
    device_->warm_up("wavelet_details", [this] { run_small_tiles(); });
    device_->warm_up("lifting", [] {});  // the same tiles launch it
  }

  Result<void> run(std::span<const WaveletTask> tasks, std::span<std::vector<float>> heights_m) override {
    assert(tasks.size() == heights_m.size());
    for (const WaveletTask& task : tasks)
      if (Result<void> ok = check_task(task); !ok) return ok;
    try {
      for (std::size_t first = 0; first < tasks.size();) {
        std::size_t end = first;
        std::vector<WaveletPlan> plans;
        BatchShape shape;
        while (end < tasks.size() && same_shape(tasks[first], tasks[end])) {
          if (!plans.empty() && (plans.size() + 1) * shape.bytes() > chunk_bytes_) break;
          plans.push_back(plan_task(tasks[end]));
          if (end == first) shape = shape_of(tasks[first], plans.front());
          ++end;
        }
        run_batch(shape, tasks.subspan(first, end - first), plans, heights_m.subspan(first, end - first));
        first = end;
      }
    } catch (const DeviceError& error) {
      clFinish(queue_.get());  // nothing may run on buffers that are about to be reused
      return error.to_error().within("synthesising tiles on " + device_->description().name);
    }
    return {};
  }

 private:
  // One tile per basis that needs every kernel.
  void run_small_tiles() {
    // PoCL's table of compiled kernels breaks (an assertion ends the process) when two threads are the first to launch the same
    // variant of a kernel, and it makes variants by launch size: so tiles of all sizes and kinds are run here, by one thread.
    for (const int posts : {5, 257}) {
      for (const int depth : {1, 4}) {
        for (const WaveletBasis basis : {WaveletBasis::kCdf22, WaveletBasis::kCdf44}) {
          for (const WaveletMethod method : {WaveletMethod::kLsa, WaveletMethod::kGsa, WaveletMethod::kLinear}) {
            for (const bool has_mask : {true, false}) run_warm_tile(posts, depth, basis, method, has_mask);
          }
        }
      }
    }
  }

  void run_warm_tile(int posts, int depth, WaveletBasis basis, WaveletMethod method, bool has_mask) {
    WaveletTask task;
    task.world = {0, 0, 256, 256};
    task.posts = posts;
    task.depth = depth;
    task.basis = basis;
    task.method = method;
    const PostWindow coarse = coarse_window(task), pixels = mask_window(task, 0);
    task.coarse_m.assign(area(static_cast<std::size_t>(coarse.width()), static_cast<std::size_t>(coarse.height())), 0.0f);
    for (SigmaMap& map : task.maps) map = {0, 0, 128, 128, 128, 128, std::vector<float>(128 * 128, 1.0f), std::vector<float>(128 * 128, 0.5f)};
    if (has_mask) {
      task.mask = MaskCrop{0, pixels.i0, pixels.j0, static_cast<int>(pixels.width()), static_cast<int>(pixels.height()), {}};
      task.mask->pixels.assign(area(static_cast<std::size_t>(pixels.width()), static_cast<std::size_t>(pixels.height())), 100);
    }
    const std::vector<WaveletPlan> plans{plan_task(task)};
    std::vector<float> heights;
    run_batch(shape_of(task, plans.front()), {&task, 1}, plans, {&heights, 1});
  }

  void run_batch(const BatchShape& shape, std::span<const WaveletTask> tasks, const std::vector<WaveletPlan>& plans,
                 std::span<std::vector<float>> heights_m) {
    const std::size_t tiles = tasks.size(), depth = shape.levels.size();
    sigma_floats_ = mask_ints_ = 0;
    words_.assign(tiles * depth * LS_HEADER_WORDS, 0);
    bool any_detail = false, any_lsa = false, any_mask = false;
    for (std::size_t tile = 0; tile < tiles; ++tile) {
      pack(shape, tile, tasks[tile], plans[tile]);
      any_detail = any_detail || plans[tile].method != WaveletMethod::kLinear;
      any_lsa = any_lsa || plans[tile].method == WaveletMethod::kLsa;
      any_mask = any_mask || plans[tile].has_mask;
    }
    words_.resize(words_.size() + kSlack);

    const std::size_t bytes = words_.size() * sizeof(std::uint32_t);
    const cl_mem parameters = parameters_.need(context_, bytes);
    {
      Mapped mapped(queue_.get(), parameters, CL_MAP_WRITE_INVALIDATE_REGION, bytes);
      std::memcpy(mapped.data(), words_.data(), bytes);
      mapped.release();
    }
    const cl_mem sigma = sigma_.need(context_, (sigma_floats_ + kSlack) * 4), sums = sums_.need(context_, (mask_ints_ + kSlack) * 4);
    const cl_mem detail = detail_.need(context_, tiles * shape.detail * 4), heights = heights_.need(context_, tiles * shape.heights * 4 + 4);
    const cl_mem out = out_.need(context_, tiles * shape.out * 4);
    const auto widest = static_cast<std::size_t>(shape.levels.back().stride) + 16;
    if (any_lsa) {
      set_args(sigma_rows_.get(), parameters, sigma);
      launch(queue_.get(), sigma_rows_.get(), local_, widest, tiles * depth * 3);
    }
    if (any_mask) {
      set_args(mask_rows_.get(), parameters, sums);
      launch(queue_.get(), mask_rows_.get(), local_, widest, tiles * depth);
    }
    if (any_detail) {
      const LevelShape& last = shape.levels.back();
      set_args(details_.get(), parameters, sigma, sums, detail);
      launch(queue_.get(), details_.get(), local_, (area(static_cast<std::size_t>(last.stride), static_cast<std::size_t>(last.columns)) + 15) / 16, tiles * depth);
    }
    for (std::size_t s = 0; s < depth; ++s) {
      const cl_mem from = s == 0 ? parameters : heights, to = s + 1 == depth ? out : heights;
      if (shape.basis == WaveletBasis::kCdf22) inverse22(shape, s, tiles, parameters, from, detail, to);
      else inverse44(shape, s, tiles, parameters, from, detail, to);
    }
    Mapped mapped(queue_.get(), out, CL_MAP_READ, tiles * shape.out * 4);
    const LevelShape& last = shape.levels.back();
    const int halo = basis_halo(shape.basis).coarse;
    for (std::size_t tile = 0; tile < tiles; ++tile) {
      const auto posts = static_cast<std::size_t>(tasks[tile].posts);
      const LevelPlan& level = plans[tile].levels.back();
      const float* data = static_cast<const float*>(mapped.data()) + tile * shape.out +
                          static_cast<std::size_t>(level.crop_y + halo) * last.out_stride + static_cast<std::size_t>(level.crop_x + halo);
      if (last.out_stride == posts) {
        heights_m[tile].assign(data, data + posts * posts);
        continue;
      }
      heights_m[tile].resize(posts * posts);
      for (std::size_t row = 0; row < posts; ++row)
        std::memcpy(heights_m[tile].data() + row * posts, data + row * last.out_stride, posts * sizeof(float));
    }
    mapped.release();
    // The unmapping must be over before another object of this process may free the memory.
    LS_CL(clFinish(queue_.get()));
  }

  void inverse22(const BatchShape& shape, std::size_t s, std::size_t tiles, cl_mem parameters, cl_mem from, cl_mem detail, cl_mem to) {
    const LevelShape& level = shape.levels[s];
    const auto rows = static_cast<cl_uint>(level.posts), blocks = std::max<cl_uint>((rows - 1) / 16, 1);
    const auto first = static_cast<cl_uint>(s * LS_HEADER_WORDS), step = static_cast<cl_uint>(shape.levels.size() * LS_HEADER_WORDS);
    set_args(inverse22_.get(), parameters, first, step, from, detail, to, rows, blocks, strip_);
    launch(queue_.get(), inverse22_.get(), local_, area((rows + strip_ - 1) / strip_, blocks), tiles);
  }

  // Columns of c and d2, columns of d1 and d3, then rows of both.
  void inverse44(const BatchShape& shape, std::size_t s, std::size_t tiles, cl_mem parameters, cl_mem from, cl_mem detail, cl_mem to) {
    const LevelShape& level = shape.levels[s];
    const auto u = [](std::size_t value) { return static_cast<cl_uint>(value); };
    const cl_uint first = u(s * LS_HEADER_WORDS), step = u(shape.levels.size() * LS_HEADER_WORDS);
    const cl_uint posts = u(static_cast<std::size_t>(level.posts)), stride = u(static_cast<std::size_t>(level.stride)),
                  lead = u(static_cast<std::size_t>(level.lead)), made = u(static_cast<std::size_t>(level.made)),
                  columns = u(static_cast<std::size_t>(level.columns));
    const cl_uint d1 = u(level.detail_at), d2 = d1 + u(level.plane), d3 = d2 + u(level.plane), detail_tile = u(shape.detail);
    const cl_mem lines = lines_.need(context_, 4 * shape.lines * tiles);
    const cl_uint lines_tile = u(shape.lines), hx = made * posts, one = 1, zero = 0;
    const cl_uint source_stride = s == 0 ? posts : u(shape.levels[s - 1].out_stride);
    const auto pass = [&](cl_uint count_lines) {
      launch(queue_.get(), inverse44_.get(), local_, area(count_lines, posts - 2), tiles);
    };
    set_args(inverse44_.get(), parameters, first, step, from, zero, zero, one, source_stride, detail, d2 + lead, detail_tile, one, stride,
             lines, zero, lines_tile, one, posts, posts, posts);
    pass(posts);
    set_args(inverse44_.get(), parameters, first, step, detail, d1 + lead * stride, detail_tile, one, stride, detail, d3, detail_tile, one,
             stride, lines, hx, lines_tile, one, stride, columns, posts);
    pass(columns);
    const cl_uint out_tile = u(s + 1 == shape.levels.size() ? shape.out : shape.heights);
    set_args(inverse44_.get(), parameters, first, step, lines, zero, lines_tile, posts, one, lines, hx, lines_tile, stride, one, to,
             u(level.out_at), out_tile, u(level.out_stride), one, made, posts);
    pass(made);
  }

  template <class T>
  std::uint32_t append(const std::vector<T>& values) {
    static_assert(sizeof(T) == 4);
    const std::size_t at = words_.size();
    words_.resize(at + values.size());
    std::memcpy(words_.data() + at, values.data(), values.size() * 4);
    return static_cast<std::uint32_t>(at);
  }

  void pack(const BatchShape& shape, std::size_t tile, const WaveletTask& task, const WaveletPlan& plan) {
    const std::uint32_t coarse_at = append(task.coarse_m);
    for (std::size_t s = 0; s < plan.levels.size(); ++s) {
      const LevelPlan& level = plan.levels[s];
      const LevelShape& place = shape.levels[s];
      std::array<std::uint32_t, LS_HEADER_WORDS> h{};
      const bool is_last = s + 1 == plan.levels.size();
      h[LS_H_MODE] = plan.method == WaveletMethod::kLinear ? LS_MODE_LINEAR : plan.method == WaveletMethod::kGsa ? LS_MODE_GSA : LS_MODE_LSA;
      h[LS_H_BLOCKS] = (static_cast<std::uint32_t>(level.stride * level.columns) + 15) / 16;
      h[LS_H_STRIDE] = static_cast<std::uint32_t>(level.stride);
      h[LS_H_DETAIL_AT] = static_cast<std::uint32_t>(tile * shape.detail + place.detail_at);
      h[LS_H_PLANE] = static_cast<std::uint32_t>(place.plane);
      h[LS_H_BASE_I] = level.base_i;
      h[LS_H_BASE_J] = level.base_j;
      h[LS_H_LEVEL] = static_cast<std::uint32_t>(level.level);
      h[LS_H_SEED0] = static_cast<std::uint32_t>(task.seed);
      h[LS_H_SEED1] = static_cast<std::uint32_t>(task.seed >> 32);
      h[LS_H_OUT_AT] = static_cast<std::uint32_t>(tile * (is_last ? shape.out : shape.heights) + place.out_at);
      h[LS_H_OUT_STRIDE] = static_cast<std::uint32_t>(place.out_stride);
      if (s == 0) {
        h[LS_H_SOURCE_AT] = coarse_at;
        h[LS_H_SOURCE_STRIDE] = static_cast<std::uint32_t>(level.posts);
      } else {
        const LevelShape& before = shape.levels[s - 1];
        const LevelPlan& crop = plan.levels[s - 1];
        h[LS_H_SOURCE_STRIDE] = static_cast<std::uint32_t>(before.out_stride);
        h[LS_H_SOURCE_AT] = static_cast<std::uint32_t>(tile * shape.heights + before.out_at) +
                            static_cast<std::uint32_t>(crop.crop_y) * h[LS_H_SOURCE_STRIDE] + static_cast<std::uint32_t>(crop.crop_x);
      }
      if (plan.method != WaveletMethod::kLinear) {
        h[LS_H_COLUMNS_ODD_AT] = append(level.columns_odd);
        h[LS_H_COLUMNS_EVEN_AT] = append(level.columns_even);
        h[LS_H_ROWS_ODD_AT] = append(level.rows_odd);
        h[LS_H_ROWS_EVEN_AT] = append(level.rows_even);
        for (std::size_t band = 0; band < 3; ++band) h[LS_H_SIGMA + band] = std::bit_cast<std::uint32_t>(level.sigma_m[band]);
      }
      if (plan.method == WaveletMethod::kLsa) pack_maps(task, level, h);
      if (plan.has_mask) pack_mask(plan.masks[s], level, h);
      std::copy(h.begin(), h.end(), words_.begin() + static_cast<std::ptrdiff_t>((tile * plan.levels.size() + s) * LS_HEADER_WORDS));
    }
  }

  void pack_maps(const WaveletTask& task, const LevelPlan& level, std::array<std::uint32_t, LS_HEADER_WORDS>& h) {
    h[LS_H_MAP_SHIFT] = static_cast<std::uint32_t>(level.map_shift);
    h[LS_H_MAP_NEAREST] = task.lookup == SigmaLookup::kNearest;
    for (std::size_t band = 0; band < 3; ++band) {
      const SigmaPlan& map = level.maps[band];
      h[LS_H_MAP_AT + band] = append(map.sigma_m);
      h[LS_H_MAP_WIDTH + band] = static_cast<std::uint32_t>(map.width);
      h[LS_H_MAP_HEIGHT + band] = static_cast<std::uint32_t>(map.height);
      h[LS_H_MAP_U + band] = static_cast<std::uint32_t>(map.u);
      h[LS_H_MAP_ROWS_AT + band] = static_cast<std::uint32_t>(words_.size());
      for (std::size_t row = 0; row < map.row_entry.size(); ++row) {
        words_.push_back(static_cast<std::uint32_t>(map.row_entry[row]));
        words_.push_back(std::bit_cast<std::uint32_t>(map.row_fraction[row]));
      }
      h[LS_H_SIGMA_ROWS_AT + band] = static_cast<std::uint32_t>(sigma_floats_);
      sigma_floats_ += area(static_cast<std::size_t>(map.height), static_cast<std::size_t>(level.stride) + 16);
    }
  }

  void pack_mask(const MaskPlan& mask, const LevelPlan& level, std::array<std::uint32_t, LS_HEADER_WORDS>& h) {
    h[LS_H_MASK_AT] = static_cast<std::uint32_t>(words_.size());
    words_.insert(words_.end(), mask.source.begin(), mask.source.end());
    h[LS_H_MASK_WIDTH] = static_cast<std::uint32_t>(mask.width);
    h[LS_H_MASK_HEIGHT] = static_cast<std::uint32_t>(mask.height);
    h[LS_H_MASK_X] = static_cast<std::uint32_t>(mask.x);
    h[LS_H_MASK_SHIFT] = static_cast<std::uint32_t>(mask.shift);
    h[LS_H_MASK_VERTICES] = mask.is_vertices;
    h[LS_H_MASK_USED_AT] = static_cast<std::uint32_t>(words_.size());
    for (std::size_t row = 0; row < mask.begin.size(); ++row) {
      words_.push_back(static_cast<std::uint32_t>(mask.begin[row]));
      words_.push_back(static_cast<std::uint32_t>(mask.end[row]));
    }
    const auto rows = [&](const std::vector<MaskRow>& list) {
      const std::size_t at = words_.size();
      for (const MaskRow& row : list) {
        std::array<std::uint8_t, 8> bytes{};
        std::copy(row.weight.begin(), row.weight.end(), bytes.begin());
        const auto word = [&](int n) {
          std::uint32_t value = 0;
          for (int k = 3; k >= 0; --k) value = value << 8 | bytes[static_cast<std::size_t>(n + k)];
          return value;
        };
        const std::array<std::uint32_t, LS_MASK_RECORD> record{
            static_cast<std::uint32_t>(row.first), static_cast<std::uint32_t>(row.count), word(0), word(4),
            static_cast<std::uint32_t>(row.begin), static_cast<std::uint32_t>(row.end)};
        words_.insert(words_.end(), record.begin(), record.end());
      }
      return static_cast<std::uint32_t>(at);
    };
    h[LS_H_MASK_ROWS_ODD_AT] = rows(mask.rows_odd);
    h[LS_H_MASK_ROWS_EVEN_AT] = rows(mask.rows_even);
    const std::size_t sums = area(static_cast<std::size_t>(mask.height), static_cast<std::size_t>(level.stride) + 16);
    h[LS_H_MASK_SUMS_ODD_AT] = static_cast<std::uint32_t>(mask_ints_);
    h[LS_H_MASK_SUMS_EVEN_AT] = static_cast<std::uint32_t>(mask_ints_ + sums);
    mask_ints_ += 2 * sums;
  }

  const std::shared_ptr<Device> device_;
  const cl_context context_;
  const std::size_t local_;
  const std::size_t chunk_bytes_;
  const cl_uint strip_;  // coarse rows per work-item of the lifting: long on a CPU, short where many work-items are needed
  const ClQueue queue_;
  const ClKernel sigma_rows_, mask_rows_, details_, inverse22_, inverse44_;
  GrowingBuffer parameters_{true}, sigma_{false}, sums_{false}, detail_{false}, heights_{false}, lines_{false}, out_{true};
  std::vector<std::uint32_t> words_;  // parameter buffer in the making
  std::size_t sigma_floats_ = 0, mask_ints_ = 0;
};

}  // namespace

Result<std::unique_ptr<WaveletSynthesis>> make_device_wavelet_synthesis(std::shared_ptr<Device> device) {
  try {
    return std::unique_ptr<WaveletSynthesis>(std::make_unique<DeviceSynthesis>(std::move(device)));
  } catch (const DeviceError& error) {
    return error.to_error().within("preparing wavelet synthesis");
  }
}

}  // namespace lodestone
