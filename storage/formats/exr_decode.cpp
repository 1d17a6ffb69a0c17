// Reading of EXR height tiles. Every declared size is checked against the file and the limit before memory is taken.
#include <OpenEXR/openexr.h>

#include <algorithm>
#include <cstring>

#include "storage/formats/exr_tile.h"

namespace lodestone {
namespace {

constexpr int kMaxEdge = 1 << 20;
constexpr int kMaxChannels = 64;

struct Reader {
  exr_context_t context = nullptr;
  std::span<const std::uint8_t> bytes;
  std::string complaint;

  ~Reader() {
    if (context != nullptr) exr_finish(&context);
  }
  Error failed(exr_result_t code, const std::string& step) const {
    const bool is_unknown = code == EXR_ERR_FEATURE_NOT_IMPLEMENTED;
    return {is_unknown ? ErrorCode::kUnsupported : ErrorCode::kCorrupt,
            "EXR tile of " + std::to_string(bytes.size()) + " bytes: " + step + ": " +
                (complaint.empty() ? exr_get_default_error_message(code) : complaint)};
  }
};

int64_t read_bytes(exr_const_context_t context, void* user, void* to, uint64_t size, uint64_t offset,
                   exr_stream_error_func_ptr_t report) {
  const auto bytes = static_cast<Reader*>(user)->bytes;
  if (offset > bytes.size()) {
    report(context, EXR_ERR_READ_IO, "offset lies behind the end of the file");
    return -1;
  }
  const uint64_t count = std::min<uint64_t>(size, bytes.size() - offset);
  if (count > 0) std::memcpy(to, bytes.data() + offset, count);
  return static_cast<int64_t>(count);
}

int64_t file_size(exr_const_context_t, void* user) {
  return static_cast<int64_t>(static_cast<Reader*>(user)->bytes.size());
}

void keep_complaint(exr_const_context_t context, exr_result_t, const char* message) {
  void* user = nullptr;
  if (context != nullptr && exr_get_user_data(context, &user) == EXR_ERR_SUCCESS && user != nullptr) {
    static_cast<Reader*>(user)->complaint = message;
  }
}

Error unsupported(const std::string& rule, const std::string& found) {
  return {ErrorCode::kUnsupported, "EXR tile: " + rule + ", found " + found};
}

struct Layout {
  int32_t first_y = 0;
  int width = 0, height = 0;
  int32_t rows_per_chunk = 0;
  int y_channel = -1, provenance_channel = -1;
};

Result<Layout> read_layout(Reader& reader, std::int64_t max_pixels) {
  exr_context_t c = reader.context;
  int parts = 0;
  exr_storage_t storage{};
  exr_get_count(c, &parts);
  if (parts != 1) return unsupported("one part", std::to_string(parts) + " parts");
  if (exr_get_storage(c, 0, &storage) != EXR_ERR_SUCCESS || storage != EXR_STORAGE_SCANLINE) {
    return unsupported("plain scan lines", "tiles or deep samples");
  }

  exr_attr_box2i_t window{};
  if (const auto r = exr_get_data_window(c, 0, &window); r != EXR_ERR_SUCCESS) return reader.failed(r, "data window");
  const std::int64_t width = std::int64_t{window.max.x} - window.min.x + 1;
  const std::int64_t height = std::int64_t{window.max.y} - window.min.y + 1;
  if (width < 1 || height < 1) {
    return Error{ErrorCode::kCorrupt, "EXR tile: data window is empty: " + std::to_string(width) + " x " + std::to_string(height)};
  }
  const exr_attr_chlist_t* channels = nullptr;
  if (const auto r = exr_get_channels(c, 0, &channels); r != EXR_ERR_SUCCESS) return reader.failed(r, "channel list");
  if (channels->num_channels > kMaxChannels) {
    return unsupported("at most " + std::to_string(kMaxChannels) + " channels", std::to_string(channels->num_channels));
  }
  if (width > kMaxEdge || height > kMaxEdge || width * height > max_pixels ||
      width * height * channels->num_channels > 4 * max_pixels) {
    return Error{ErrorCode::kTooLarge, "EXR tile: " + std::to_string(width) + " x " + std::to_string(height) + " pixels of " +
                                           std::to_string(channels->num_channels) + " channels, the limit is " +
                                           std::to_string(max_pixels) + " pixels"};
  }

  Layout layout{window.min.y, static_cast<int>(width), static_cast<int>(height)};
  for (int k = 0; k < channels->num_channels; ++k) {
    const exr_attr_chlist_entry_t& channel = channels->entries[k];
    const std::string name(channel.name.str, channel.name.length);
    if (channel.x_sampling != 1 || channel.y_sampling != 1) return unsupported("full sampling", "subsampled channel " + name);
    if (name != "Y" && name != "provenance") continue;
    if (channel.pixel_type == EXR_PIXEL_UINT) return unsupported("float or half channel " + name, "uint");
    (name == "Y" ? layout.y_channel : layout.provenance_channel) = k;
  }
  if (layout.y_channel < 0) return unsupported("a channel Y", "none of that name");

  if (const auto r = exr_get_scanlines_per_chunk(c, 0, &layout.rows_per_chunk); r != EXR_ERR_SUCCESS || layout.rows_per_chunk < 1) {
    return reader.failed(r, "lines per chunk");
  }
  // An index entry and a chunk's head are 16 bytes at least: a file that lacks them is not worth its declared memory.
  const std::int64_t chunks = (height + layout.rows_per_chunk - 1) / layout.rows_per_chunk;
  if (static_cast<std::int64_t>(reader.bytes.size()) < chunks * 16) {
    return Error{ErrorCode::kCorrupt, "EXR tile: " + std::to_string(chunks) + " chunks declared, but only " +
                                          std::to_string(reader.bytes.size()) + " bytes in the file"};
  }
  return layout;
}

Result<void> read_chunks(Reader& reader, const Layout& layout, float* heights, float* provenance) {
  exr_context_t c = reader.context;
  exr_decode_pipeline_t pipe = EXR_DECODE_PIPELINE_INITIALIZER;
  exr_result_t result = EXR_ERR_SUCCESS;
  bool is_ready = false;
  for (int row = 0; row < layout.height && result == EXR_ERR_SUCCESS; row += layout.rows_per_chunk) {
    exr_chunk_info_t chunk{};
    result = exr_read_scanline_chunk_info(c, 0, static_cast<int>(std::int64_t{layout.first_y} + row), &chunk);
    if (result != EXR_ERR_SUCCESS) break;
    const int expected = std::min(layout.rows_per_chunk, layout.height - row);
    if (chunk.start_y != layout.first_y + row || chunk.height != expected || chunk.width != layout.width) {
      result = EXR_ERR_BAD_CHUNK_LEADER;
      break;
    }
    // The library would leave the rest of a short uncompressed chunk as the memory was.
    if (chunk.packed_size > chunk.unpacked_size ||
        (chunk.compression == EXR_COMPRESSION_NONE && chunk.packed_size != chunk.unpacked_size)) {
      result = EXR_ERR_CORRUPT_CHUNK;
      break;
    }
    result = is_ready ? exr_decoding_update(c, 0, &chunk, &pipe) : exr_decoding_initialize(c, 0, &chunk, &pipe);
    if (result != EXR_ERR_SUCCESS) break;
    const auto aim = [&](int channel, float* to) {
      if (channel < 0) return;
      exr_coding_channel_info_t& info = pipe.channels[channel];
      info.user_bytes_per_element = 4;
      info.user_data_type = EXR_PIXEL_FLOAT;
      info.user_pixel_stride = 4;
      info.user_line_stride = 4 * layout.width;
      info.decode_to_ptr = reinterpret_cast<std::uint8_t*>(to + static_cast<std::size_t>(row) * layout.width);
    };
    aim(layout.y_channel, heights);
    aim(layout.provenance_channel, provenance);
    if (!is_ready) result = exr_decoding_choose_default_routines(c, 0, &pipe);
    is_ready = true;
    if (result == EXR_ERR_SUCCESS) result = exr_decoding_run(c, 0, &pipe);
  }
  exr_decoding_destroy(c, &pipe);
  if (result != EXR_ERR_SUCCESS) return reader.failed(result, "pixels");
  return {};
}

}  // namespace

Result<DecodedExr> decode_exr_tile(std::span<const std::uint8_t> bytes, std::int64_t max_pixels) {
  Reader reader;
  reader.bytes = bytes;
  exr_context_initializer_t init = EXR_DEFAULT_CONTEXT_INITIALIZER;
  init.user_data = &reader;
  init.read_fn = read_bytes;
  init.size_fn = file_size;
  init.error_handler_fn = keep_complaint;
  init.flags = EXR_CONTEXT_FLAG_DISABLE_CHUNK_RECONSTRUCTION;
  if (const auto r = exr_start_read(&reader.context, "tile.exr", &init); r != EXR_ERR_SUCCESS) {
    return reader.failed(r, "header");
  }
  auto layout = read_layout(reader, max_pixels);
  if (!layout) return std::move(layout.error());

  DecodedExr out;
  out.width = layout->width;
  out.height = layout->height;
  const std::size_t count = static_cast<std::size_t>(out.width) * out.height;
  out.heights_m.resize(count);
  std::vector<float> provenance(layout->provenance_channel < 0 ? 0 : count);
  if (auto read = read_chunks(reader, *layout, out.heights_m.data(), provenance.data()); !read) return std::move(read.error());

  out.provenance.resize(provenance.size());
  for (std::size_t k = 0; k < provenance.size(); ++k) {
    if (provenance[k] != 0.0f && provenance[k] != 1.0f && provenance[k] != 2.0f) {
      return Error{ErrorCode::kCorrupt, "EXR tile: channel provenance holds 0, 1 or 2, pixel " + std::to_string(k) + " has " +
                                            std::to_string(provenance[k])};
    }
    out.provenance[k] = static_cast<std::uint8_t>(provenance[k]);
  }
  return out;
}

}  // namespace lodestone
