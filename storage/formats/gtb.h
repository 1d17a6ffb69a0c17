#pragma once
// The bytes of a `.gtb` progressive stream: header, chunks, a CRC-32 on each. What the payloads mean is the kernels' business
// (kernels/texture/gtb_model.h); the format is written down in docs/formats/gtb.md. Bytes are a pure function of the arguments.

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "kernels/types/gtb_stream.h"
#include "kernels/types/result.h"

namespace lodestone {

inline constexpr std::size_t kGtbHeaderBytes = 52;

// What a stream says about itself (chunk M, JSON). Numbers are rounded so that they stay true: bounds upwards.
struct GtbMetadata {
  std::optional<double> max_error_m, rms_error_m;   // of the whole stream
  // Entry k bounds the error after the split points of levels 0..k-1 (bitree_error_bounds); a stream cut inside level k is within entry k.
  std::vector<double> error_bounds_m;
  std::map<std::string, std::string> texts;         // layer, tile, crs, revision, ..
};

// Pieces of a stream, to be sent one after another: header, metadata (at most once, right after the header), then chunks.
std::string gtb_header_bytes(const GtbHeader& header);
std::string gtb_metadata_bytes(const GtbMetadata& metadata);
std::string gtb_chunk_bytes(const GtbChunk& chunk);
// All of it.
std::string encode_gtb(const GtbStream& stream, const GtbMetadata* metadata = nullptr);

struct GtbLimits {
  int max_n_geo = 13, max_n_tex = 13;
  std::size_t max_payload_bytes = std::size_t{1} << 24;
  std::size_t max_metadata_bytes = std::size_t{1} << 16;
};

// Takes a stream in pieces of any size, as they arrive, and gives whole chunks with good checksums. Holds at most one unfinished chunk.
// After an error, or after chunk E, nothing more comes.
class GtbReader {
 public:
  explicit GtbReader(GtbLimits limits = {}) : limits_(limits) {}

  // Errors: kCorrupt (checksum, unknown chunk, order, bytes after E), kUnsupported (version, predictor, flags), kTooLarge (limits). The
  // message names the byte. Chunks that came before the error stay good; they are in take().
  Result<void> push(std::span<const std::uint8_t> bytes);

  const std::optional<GtbHeader>& header() const { return header_; }
  const std::optional<GtbMetadata>& metadata() const { return metadata_; }
  // Chunks since the last call, without M; E is given as the last one.
  std::vector<GtbChunk> take();
  bool is_complete() const { return has_ended_; }
  // Bytes of whole, good pieces so far: the place to cut or resume the stream.
  std::size_t good_bytes() const { return good_bytes_; }

 private:
  Result<bool> read_piece(std::span<const std::uint8_t> rest, std::size_t& used);
  Result<bool> read_header(std::span<const std::uint8_t> rest, std::size_t& used);
  Result<bool> read_chunk(std::span<const std::uint8_t> rest, std::size_t& used);
  Result<void> read_metadata(std::span<const std::uint8_t> payload);
  std::string place() const;

  GtbLimits limits_;
  std::optional<GtbHeader> header_;
  std::optional<GtbMetadata> metadata_;
  std::vector<GtbChunk> chunks_;
  std::vector<std::uint8_t> pending_;
  std::size_t good_bytes_ = 0;
  bool has_ended_ = false, has_failed_ = false, has_chunks_ = false;
};

// What a whole or cut stream in memory holds. `stopped`: why reading ended before chunk E; empty when the bytes simply ended.
struct GtbPrefix {
  GtbStream stream;
  std::optional<GtbMetadata> metadata;
  std::size_t good_bytes = 0;
  bool is_complete = false;
  std::string stopped;
};
// Errors only where not even the header is whole and good; everything later ends the list of chunks instead.
Result<GtbPrefix> decode_gtb(std::span<const std::uint8_t> bytes, const GtbLimits& limits = {});

}  // namespace lodestone
