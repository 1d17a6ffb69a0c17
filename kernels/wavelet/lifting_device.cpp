// Launcher of lifting.cl for whole grids.

#include <algorithm>

#include "kernels/device/cl_handles.h"
#include "kernels/shared/ls_wavelet.h"
#include "kernels/wavelet/lifting.h"

namespace lodestone {

namespace {

constexpr std::size_t kSlack = 64;

class GridLifting final : public DeviceLifting {
 public:
  explicit GridLifting(std::shared_ptr<Device> device)
      : device_(std::move(device)),
        queue_(make_queue(device_->context(), device_->id())),
        forward_(make_kernel(device_->program("lifting"), "ls_forward")),
        inverse22_(make_kernel(device_->program("lifting"), "ls_inverse22")),
        inverse44_(make_kernel(device_->program("lifting"), "ls_inverse44")) {}

  Result<GridBands> forward(WaveletBasis basis, const std::vector<float>& fine_m, int width, int height) override {
    try {
      const auto u = [](int value) { return static_cast<cl_uint>(value); };
      const cl_uint lw = u((width + 1) / 2), hw = u(width / 2), lh = u((height + 1) / 2), hh = u(height / 2), w = u(width), h = u(height);
      const cl_uint cubic = basis == WaveletBasis::kCdf44, one = 1;
      const ClBuffer in = filled(fine_m), low = empty(lw * h), high = empty(hw * h);
      const std::array<ClBuffer, 4> out{empty(lw * lh), empty(hw * lh), empty(lw * hh), empty(hw * hh)};
      const auto pass = [&](const ClBuffer& from, cl_uint line, cl_uint step, cl_uint lines, cl_uint count, const ClBuffer& to_low,
                            cl_uint low_line, cl_uint low_step, const ClBuffer& to_high, cl_uint high_line, cl_uint high_step) {
        set_args(forward_.get(), from.get(), line, step, lines, count, cubic, to_low.get(), low_line, low_step, to_high.get(), high_line, high_step);
        launch(queue_.get(), forward_.get(), static_cast<std::size_t>(device_->local_size()), std::size_t{lines} * ((count + 1) / 2), 1);
      };
      pass(in, w, one, h, w, low, lw, one, high, hw, one);
      pass(low, one, lw, lw, h, out[0], one, lw, out[2], one, lw);
      pass(high, one, hw, hw, h, out[1], one, hw, out[3], one, hw);
      GridBands bands{width, height, read(out[0], lw * lh), {read(out[1], hw * lh), read(out[2], lw * hh), read(out[3], hw * hh)}};
      return bands;
    } catch (const DeviceError& error) {
      return error.to_error().within("analysing a grid");
    }
  }

  Result<std::vector<float>> inverse(WaveletBasis basis, const GridBands& bands) override {
    try {
      const HaloedBands in = add_halo(basis, bands);
      return basis == WaveletBasis::kCdf22 ? inverse22(bands, in) : inverse44(bands, in);
    } catch (const DeviceError& error) {
      return error.to_error().within("synthesising a grid");
    }
  }

 private:
  std::vector<float> inverse22(const GridBands& bands, const HaloedBands& in) {
    // Blocks of 16: planes get room for whole ones.
    const auto blocks = static_cast<cl_uint>(std::max((in.width - 1 + 15) / 16, 1));
    const std::size_t width = blocks * 16 + 1, stride = width + 1, rows = static_cast<std::size_t>(in.height);
    const std::size_t out_stride = 2 * width - 1 < 48 ? 48 : 2 * width - 1, plane = stride * (rows + 1) + kSlack;
    std::array<std::uint32_t, LS_HEADER_WORDS> h{};
    h[LS_H_MODE] = LS_MODE_GSA;
    h[LS_H_STRIDE] = static_cast<cl_uint>(stride);
    h[LS_H_PLANE] = static_cast<cl_uint>(plane);
    h[LS_H_SOURCE_STRIDE] = static_cast<cl_uint>(width);
    h[LS_H_OUT_STRIDE] = static_cast<cl_uint>(out_stride);
    std::vector<float> coarse(width * rows), detail(3 * plane);
    for (std::size_t row = 0; row < rows; ++row)
      std::copy_n(in.low_m.begin() + static_cast<std::ptrdiff_t>(row) * in.width, in.width, coarse.begin() + static_cast<std::ptrdiff_t>(row * width));
    for (std::size_t band = 0; band < 3; ++band)
      for (std::size_t row = 0; row <= rows; ++row)
        std::copy_n(in.detail_m[band].begin() + static_cast<std::ptrdiff_t>(row) * in.stride, in.stride,
                    detail.begin() + static_cast<std::ptrdiff_t>(band * plane + row * stride));
    const std::size_t out_count = out_stride * (2 * rows - 1);
    const ClBuffer header = filled(h), c = filled(coarse), d = filled(detail), out = empty(out_count);
    const cl_uint zero = 0, strip = 16, row_count = static_cast<cl_uint>(rows);
    set_args(inverse22_.get(), header.get(), zero, zero, c.get(), d.get(), out.get(), row_count, blocks, strip);
    launch(queue_.get(), inverse22_.get(), static_cast<std::size_t>(device_->local_size()), std::size_t{blocks} * ((row_count + strip - 1) / strip), 1);
    return cropped(read(out, out_count), out_stride, bands, 0);
  }

  std::vector<float> inverse44(const GridBands& bands, const HaloedBands& in) {
    const auto u = [](int value) { return static_cast<cl_uint>(value); };
    const cl_uint width = u(in.width), height = u(in.height), stride = u(in.stride), lead = u(in.lead);
    const cl_uint made_x = 2 * width - 5, made_y = 2 * height - 5, zero = 0, one = 1;
    std::array<std::uint32_t, LS_HEADER_WORDS> h{};
    h[LS_H_MODE] = LS_MODE_GSA;
    const ClBuffer header = filled(h), c = filled(in.low_m), d1 = filled(in.detail_m[0]), d2 = filled(in.detail_m[1]), d3 = filled(in.detail_m[2]);
    const ClBuffer lo = empty(width * made_y), hx = empty(stride * made_y), out = empty(made_x * made_y);
    const auto pass = [&](const ClBuffer& coarse, cl_uint coarse_at, cl_uint coarse_line, cl_uint coarse_step, const ClBuffer& detail,
                          cl_uint detail_at, cl_uint detail_line, cl_uint detail_step, const ClBuffer& to, cl_uint out_line, cl_uint out_step,
                          cl_uint lines, cl_uint count) {
      set_args(inverse44_.get(), header.get(), zero, zero, coarse.get(), coarse_at, one, coarse_line, coarse_step, detail.get(), detail_at, zero,
               detail_line, detail_step, to.get(), zero, zero, out_line, out_step, lines, count);
      launch(queue_.get(), inverse44_.get(), static_cast<std::size_t>(device_->local_size()), std::size_t{lines} * (count - 2), 1);
    };
    pass(c, 0, 1, width, d2, lead, 1, stride, lo, 1, width, width, height);
    pass(d1, lead * stride, 1, stride, d3, 0, 1, stride, hx, 1, stride, stride, height);
    pass(lo, 0, width, 1, hx, 0, stride, 1, out, made_x, 1, made_y, width);
    return cropped(read(out, made_x * made_y), made_x, bands, static_cast<std::size_t>(in.fine_skip));
  }

  static std::vector<float> cropped(const std::vector<float>& from, std::size_t stride, const GridBands& bands, std::size_t skip) {
    std::vector<float> out;
    for (std::size_t j = 0; j < static_cast<std::size_t>(bands.height); ++j) {
      const auto row = from.begin() + static_cast<std::ptrdiff_t>((j + skip) * stride + skip);
      out.insert(out.end(), row, row + bands.width);
    }
    return out;
  }

  ClBuffer empty(std::size_t floats) { return make_buffer(device_->context(), CL_MEM_READ_WRITE, (floats + kSlack) * 4); }
  template <class Values>
  ClBuffer filled(const Values& values) {
    ClBuffer buffer = empty(values.size());
    LS_CL(clEnqueueWriteBuffer(queue_.get(), buffer.get(), CL_TRUE, 0, values.size() * 4, values.data(), 0, nullptr, nullptr));
    return buffer;
  }
  std::vector<float> read(const ClBuffer& buffer, std::size_t floats) {
    std::vector<float> values(floats);
    LS_CL(clEnqueueReadBuffer(queue_.get(), buffer.get(), CL_TRUE, 0, floats * 4, values.data(), 0, nullptr, nullptr));
    return values;
  }

  const std::shared_ptr<Device> device_;
  const ClQueue queue_;
  const ClKernel forward_, inverse22_, inverse44_;
};

}  // namespace

Result<std::unique_ptr<DeviceLifting>> DeviceLifting::create(std::shared_ptr<Device> device) {
  try {
    return std::unique_ptr<DeviceLifting>(std::make_unique<GridLifting>(std::move(device)));
  } catch (const DeviceError& error) {
    return error.to_error().within("preparing the lifting kernels");
  }
}

}  // namespace lodestone
