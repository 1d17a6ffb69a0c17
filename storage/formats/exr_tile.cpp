#include "storage/formats/exr_tile.h"

#include <Imath/half.h>
#include <OpenEXR/openexr.h>
#include <libdeflate.h>

#include <bit>
#include <cmath>
#include <cstring>
#include <memory>
#include <new>

namespace lodestone {
namespace {

static_assert(std::endian::native == std::endian::little, "EXR samples are copied as they lie in memory");

constexpr int kDeflateLevel = 4;
constexpr int kMaxPosts = 1 << 14;
constexpr float kHalfEnd = 65520.0f;  // from here on a half rounds to infinity

struct FreeCompressor {
  void operator()(libdeflate_compressor* c) const noexcept { libdeflate_free_compressor(c); }
};

// One write context; the library's last words are kept for the error.
struct Writer {
  exr_context_t context = nullptr;
  std::string bytes;
  std::string complaint;

  ~Writer() {
    if (context != nullptr) exr_finish(&context);
  }
  Error failed(const std::string& step, const TileAttributes& a) const {
    return {ErrorCode::kInternal, "EXR tile " + a.layer + " " + std::to_string(a.z) + "/" + std::to_string(a.x) + "/" +
                                      std::to_string(a.y) + ": " + step + " failed: " + complaint};
  }
};

int64_t write_bytes(exr_const_context_t context, void* user, const void* data, uint64_t size, uint64_t offset,
                    exr_stream_error_func_ptr_t report) {
  std::string& bytes = static_cast<Writer*>(user)->bytes;
  try {
    if (offset == bytes.size()) {
      bytes.append(static_cast<const char*>(data), size);
    } else {
      if (offset + size > bytes.size()) bytes.resize(offset + size);
      std::memcpy(bytes.data() + offset, data, size);
    }
  } catch (const std::bad_alloc&) {
    report(context, EXR_ERR_OUT_OF_MEMORY, "no memory for %llu bytes", static_cast<unsigned long long>(offset + size));
    return -1;
  }
  return static_cast<int64_t>(size);
}

void keep_complaint(exr_const_context_t context, exr_result_t, const char* message) {
  void* user = nullptr;
  if (context != nullptr && exr_get_user_data(context, &user) == EXR_ERR_SUCCESS && user != nullptr) {
    static_cast<Writer*>(user)->complaint = message;
  }
}

exr_compression_t exr_compression(ExrCompression c) {
  switch (c) {
    case ExrCompression::kNone: return EXR_COMPRESSION_NONE;
    case ExrCompression::kZip: return EXR_COMPRESSION_ZIP;
    case ExrCompression::kPiz: return EXR_COMPRESSION_PIZ;
    case ExrCompression::kPxr24: return EXR_COMPRESSION_PXR24;
  }
  return EXR_COMPRESSION_NONE;
}

exr_result_t set_attributes(exr_context_t c, const TileAttributes& a) {
  const std::string seed = std::to_string(a.seed);
  const std::string tile = std::to_string(a.z) + "/" + std::to_string(a.x) + "/" + std::to_string(a.y);
  const std::pair<const char*, const std::string*> texts[] = {
      {"layer", &a.layer}, {"recipe", &a.recipe}, {"revision", &a.revision}, {"seed", &seed},
      {"tile", &tile},     {"crs", &a.crs},       {"unit", &a.unit},         {"datum", &a.datum}};
  for (const auto& [name, text] : texts) {
    if (const auto r = exr_attr_set_string(c, 0, name, text->c_str()); r != EXR_ERR_SUCCESS) return r;
  }
  const exr_attr_v2d_t origin{{{a.origin_x, a.origin_y}}};
  const exr_attr_v2d_t spacing{{{a.spacing_x, a.spacing_y}}};
  const exr_attr_v2f_t range{{{a.height_min_m, a.height_max_m}}};
  if (const auto r = exr_attr_set_v2d(c, 0, "origin", &origin); r != EXR_ERR_SUCCESS) return r;
  if (const auto r = exr_attr_set_v2d(c, 0, "spacing", &spacing); r != EXR_ERR_SUCCESS) return r;
  return exr_attr_set_v2f(c, 0, "height_range", &range);
}

// One channel as it lies in memory: rows of `posts` samples of sample_bytes.
struct Plane {
  const std::uint8_t* samples = nullptr;
  int sample_bytes = 4;
};

// EXR's ZIP: even bytes, then odd bytes, then the difference of neighbouring bytes plus 128.
void split_and_delta(const std::uint8_t* raw, std::size_t size, std::uint8_t* split, std::uint8_t* out) {
  const std::size_t even = (size + 1) / 2;
  for (std::size_t k = 0; k < size / 2; ++k) {
    split[k] = raw[2 * k];
    split[even + k] = raw[2 * k + 1];
  }
  if (size % 2 != 0) split[even - 1] = raw[size - 1];
  out[0] = split[0];
  for (std::size_t k = 1; k < size; ++k) out[k] = static_cast<std::uint8_t>(split[k] - split[k - 1] + 128);
}

// Chunks of none and zip: packed here, framed and indexed by the library.
exr_result_t write_packed(exr_context_t c, std::span<const Plane> planes, int posts, ExrCompression compression) {
  int32_t rows = 0;
  if (const auto r = exr_get_scanlines_per_chunk(c, 0, &rows); r != EXR_ERR_SUCCESS) return r;
  std::size_t row_bytes = 0;
  for (const Plane& p : planes) row_bytes += static_cast<std::size_t>(p.sample_bytes) * posts;

  std::vector<std::uint8_t> packed, split, delta, deflated;
  if (planes.size() > 1) packed.resize(row_bytes * rows);
  if (compression == ExrCompression::kZip) {
    for (auto* buffer : {&split, &delta, &deflated}) buffer->resize(row_bytes * rows);
  }
  thread_local const std::unique_ptr<libdeflate_compressor, FreeCompressor> deflater(
      libdeflate_alloc_compressor(kDeflateLevel));
  if (deflater == nullptr) return EXR_ERR_OUT_OF_MEMORY;

  for (int y = 0; y < posts; y += rows) {
    const int count = std::min<int>(rows, posts - y);
    const std::size_t size = row_bytes * count;
    const std::uint8_t* data = planes[0].samples + row_bytes * y;
    if (planes.size() > 1) {
      std::uint8_t* to = packed.data();
      for (int row = y; row < y + count; ++row) {
        for (const Plane& p : planes) {
          const std::size_t bytes = static_cast<std::size_t>(p.sample_bytes) * posts;
          std::memcpy(to, p.samples + bytes * row, bytes);
          to += bytes;
        }
      }
      data = packed.data();
    }
    std::size_t stored = size;
    if (compression == ExrCompression::kZip) {
      split_and_delta(data, size, split.data(), delta.data());
      // Room for size - 1: a chunk that does not shrink is stored as it is, which readers know by its size.
      const std::size_t n = libdeflate_zlib_compress(deflater.get(), delta.data(), size, deflated.data(), size - 1);
      if (n != 0) {
        stored = n;
        data = deflated.data();
      }
    }
    if (const auto r = exr_write_scanline_chunk(c, 0, y, data, stored); r != EXR_ERR_SUCCESS) return r;
  }
  return EXR_ERR_SUCCESS;
}

// Chunks of piz and pxr24: the library's own encoders.
exr_result_t write_encoded(exr_context_t c, std::span<const Plane> planes, int posts) {
  int32_t rows = 0;
  if (const auto r = exr_get_scanlines_per_chunk(c, 0, &rows); r != EXR_ERR_SUCCESS) return r;
  exr_encode_pipeline_t pipe = EXR_ENCODE_PIPELINE_INITIALIZER;
  exr_result_t result = EXR_ERR_SUCCESS;
  for (int y = 0; y < posts && result == EXR_ERR_SUCCESS; y += rows) {
    exr_chunk_info_t chunk{};
    result = exr_write_scanline_chunk_info(c, 0, y, &chunk);
    if (result != EXR_ERR_SUCCESS) break;
    result = y == 0 ? exr_encoding_initialize(c, 0, &chunk, &pipe) : exr_encoding_update(c, 0, &chunk, &pipe);
    if (result != EXR_ERR_SUCCESS) break;
    for (std::size_t k = 0; k < planes.size(); ++k) {
      const int bytes = planes[k].sample_bytes;
      pipe.channels[k].user_pixel_stride = bytes;
      pipe.channels[k].user_line_stride = bytes * posts;
      pipe.channels[k].encode_from_ptr = planes[k].samples + static_cast<std::size_t>(bytes) * posts * y;
    }
    if (y == 0) result = exr_encoding_choose_default_routines(c, 0, &pipe);
    if (result == EXR_ERR_SUCCESS) result = exr_encoding_run(c, 0, &pipe);
  }
  exr_encoding_destroy(c, &pipe);
  return result;
}

exr_result_t write_header(exr_context_t c, int posts, bool has_provenance, const TileAttributes& attributes,
                          const ExrOptions& options) {
  int part = 0;
  if (const auto r = exr_add_part(c, nullptr, EXR_STORAGE_SCANLINE, &part); r != EXR_ERR_SUCCESS) return r;
  if (const auto r = exr_initialize_required_attr_simple(c, part, posts, posts, exr_compression(options.compression));
      r != EXR_ERR_SUCCESS) {
    return r;
  }
  const auto type = options.pixel == ExrPixel::kHalf ? EXR_PIXEL_HALF : EXR_PIXEL_FLOAT;
  if (const int r = exr_add_channel(c, part, "Y", type, EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1); r != EXR_ERR_SUCCESS) return r;
  if (has_provenance) {
    if (const int r = exr_add_channel(c, part, "provenance", EXR_PIXEL_HALF, EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1);
        r != EXR_ERR_SUCCESS) {
      return r;
    }
  }
  if (const auto r = set_attributes(c, attributes); r != EXR_ERR_SUCCESS) return r;
  return exr_write_header(c);
}

}  // namespace

Result<std::string> encode_exr_tile(std::span<const float> heights_m, std::span<const std::uint8_t> provenance, int posts,
                                    const TileAttributes& attributes, const ExrOptions& options) {
  const auto count = static_cast<std::size_t>(std::max(posts, 0)) * std::max(posts, 0);
  if (posts < 1 || posts > kMaxPosts || heights_m.size() != count || (!provenance.empty() && provenance.size() != count)) {
    return Error{ErrorCode::kInvalidArgument,
                 "EXR tile: needs posts * posts heights (and as many provenance values or none) with posts in 1.." +
                     std::to_string(kMaxPosts) + ", got posts = " + std::to_string(posts) + ", " +
                     std::to_string(heights_m.size()) + " heights, " + std::to_string(provenance.size()) +
                     " provenance values"};
  }

  std::vector<std::uint16_t> half_heights, half_provenance;
  Plane planes[2] = {{reinterpret_cast<const std::uint8_t*>(heights_m.data()), 4}, {}};
  if (options.pixel == ExrPixel::kHalf) {
    half_heights.resize(count);
    for (std::size_t k = 0; k < count; ++k) {
      if (!(std::fabs(heights_m[k]) < kHalfEnd)) {
        return Error{ErrorCode::kInvalidArgument, "EXR tile: half pixels hold heights up to 65504 m, post " +
                                                      std::to_string(k) + " has " + std::to_string(heights_m[k]) +
                                                      " m; ask for float pixels"};
      }
      half_heights[k] = imath_float_to_half(heights_m[k]);
    }
    planes[0] = {reinterpret_cast<const std::uint8_t*>(half_heights.data()), 2};
  }
  if (!provenance.empty()) {
    constexpr std::uint16_t kHalfOf[3] = {0x0000, 0x3C00, 0x4000};  // 0, 1, 2
    half_provenance.resize(count);
    for (std::size_t k = 0; k < count; ++k) {
      if (provenance[k] > 2) {
        return Error{ErrorCode::kInvalidArgument, "EXR tile: provenance is 0, 1 or 2, post " + std::to_string(k) + " has " +
                                                      std::to_string(provenance[k])};
      }
      half_provenance[k] = kHalfOf[provenance[k]];
    }
    planes[1] = {reinterpret_cast<const std::uint8_t*>(half_provenance.data()), 2};
  }
  const std::span<const Plane> used(planes, provenance.empty() ? 1 : 2);

  Writer writer;
  if (options.compression == ExrCompression::kNone) {
    const std::size_t per_post = used.size() == 1 ? planes[0].sample_bytes : planes[0].sample_bytes + 2;
    writer.bytes.reserve(4096 + attributes.crs.size() + static_cast<std::size_t>(posts) * 16 + count * per_post);
  }
  exr_context_initializer_t init = EXR_DEFAULT_CONTEXT_INITIALIZER;
  init.user_data = &writer;
  init.write_fn = write_bytes;
  init.error_handler_fn = keep_complaint;
  if (exr_start_write(&writer.context, "tile.exr", EXR_WRITE_FILE_DIRECTLY, &init) != EXR_ERR_SUCCESS) {
    return writer.failed("opening", attributes);
  }
  if (write_header(writer.context, posts, !provenance.empty(), attributes, options) != EXR_ERR_SUCCESS) {
    return writer.failed("the header", attributes);
  }
  const bool is_ours = options.compression == ExrCompression::kNone || options.compression == ExrCompression::kZip;
  const auto written = is_ours ? write_packed(writer.context, used, posts, options.compression)
                               : write_encoded(writer.context, used, posts);
  if (written != EXR_ERR_SUCCESS) return writer.failed("writing pixels", attributes);
  if (exr_finish(&writer.context) != EXR_ERR_SUCCESS) return writer.failed("the index of lines", attributes);
  return std::move(writer.bytes);
}

}  // namespace lodestone
