// Encoding of one height tile: our writer beside OpenEXR's own OutputFile, both to memory, one thread. Compare rows of one run:
//   exr_bench --benchmark_repetitions=9 --benchmark_enable_random_interleaving=true --benchmark_report_aggregates_only=true
#include <OpenEXR/ImfChannelList.h>
#include <OpenEXR/ImfFrameBuffer.h>
#include <OpenEXR/ImfHeader.h>
#include <OpenEXR/ImfIO.h>
#include <OpenEXR/ImfOutputFile.h>
#include <OpenEXR/ImfThreading.h>
#include <benchmark/benchmark.h>

#include <cmath>
#include <cstdlib>
#include <cstring>

#include "storage/formats/exr_tile.h"
#include "storage/formats/quantum.h"
#include "tests/support/sample_terrain.h"

namespace {

using lodestone::ExrCompression;

// quantum_log2 = 0: raw floats; else rounded to 2^quantum_log2 metres.
std::vector<float> terrain(int posts, int quantum_log2) {
  auto heights_m = lodestone::sample_terrain(posts);
  if (quantum_log2 != 0 && !lodestone::quantise(heights_m, std::ldexp(1.0f, quantum_log2))) std::abort();
  return heights_m;
}

class MemoryStream : public Imf::OStream {
 public:
  MemoryStream() : Imf::OStream("tile.exr") {}
  void write(const char data[], int size) override {
    if (at_ + size > bytes_.size()) bytes_.resize(at_ + size);
    std::memcpy(bytes_.data() + at_, data, size);
    at_ += size;
  }
  std::uint64_t tellp() override { return at_; }
  void seekp(std::uint64_t at) override { at_ = at; }
  std::size_t size() const { return bytes_.size(); }

 private:
  std::string bytes_;
  std::uint64_t at_ = 0;
};

void report(benchmark::State& state, int posts, std::size_t size) {
  state.SetItemsProcessed(state.iterations() * posts * posts);
  state.counters["file_bytes"] = static_cast<double>(size);
}

void ours(benchmark::State& state, ExrCompression compression) {
  const int posts = static_cast<int>(state.range(0));
  const auto heights_m = terrain(posts, static_cast<int>(state.range(1)));
  std::size_t size = 0;
  for (auto _ : state) {
    auto bytes = lodestone::encode_exr_tile(heights_m, {}, posts, {}, {compression});
    size = bytes->size();
    benchmark::DoNotOptimize(bytes->data());
  }
  report(state, posts, size);
}

void library(benchmark::State& state, Imf::Compression compression) {
  Imf::setGlobalThreadCount(0);
  const int posts = static_cast<int>(state.range(0));
  auto heights_m = terrain(posts, static_cast<int>(state.range(1)));
  std::size_t size = 0;
  for (auto _ : state) {
    MemoryStream stream;
    {
      Imf::Header header(posts, posts);
      header.compression() = compression;
      header.zipCompressionLevel() = 4;
      header.channels().insert("Y", Imf::Channel(Imf::FLOAT));
      Imf::FrameBuffer frame;
      frame.insert("Y", Imf::Slice(Imf::FLOAT, reinterpret_cast<char*>(heights_m.data()), sizeof(float), sizeof(float) * posts));
      Imf::OutputFile file(stream, header, 0);
      file.setFrameBuffer(frame);
      file.writePixels(posts);
    }
    size = stream.size();
    benchmark::DoNotOptimize(size);
  }
  report(state, posts, size);
}

void decode(benchmark::State& state, ExrCompression compression) {
  const int posts = static_cast<int>(state.range(0));
  const auto bytes = lodestone::encode_exr_tile(terrain(posts, static_cast<int>(state.range(1))), {}, posts, {}, {compression});
  for (auto _ : state) {
    auto decoded = lodestone::decode_exr_tile({reinterpret_cast<const std::uint8_t*>(bytes->data()), bytes->size()});
    benchmark::DoNotOptimize(decoded->heights_m.data());
  }
  report(state, posts, bytes->size());
}

#define TILE_ROWS ArgNames({"posts", "quantum_log2"})->Args({257, 0})->Args({257, -4})->Unit(benchmark::kMicrosecond)
BENCHMARK_CAPTURE(ours, none, ExrCompression::kNone)->TILE_ROWS;
BENCHMARK_CAPTURE(ours, zip, ExrCompression::kZip)->TILE_ROWS;
BENCHMARK_CAPTURE(ours, piz, ExrCompression::kPiz)->TILE_ROWS;
BENCHMARK_CAPTURE(ours, pxr24, ExrCompression::kPxr24)->TILE_ROWS;
BENCHMARK_CAPTURE(library, none, Imf::NO_COMPRESSION)->TILE_ROWS;
BENCHMARK_CAPTURE(library, zip_level_4, Imf::ZIP_COMPRESSION)->TILE_ROWS;
BENCHMARK_CAPTURE(decode, none, ExrCompression::kNone)->TILE_ROWS;
BENCHMARK_CAPTURE(decode, zip, ExrCompression::kZip)->TILE_ROWS;
BENCHMARK_CAPTURE(decode, pxr24, ExrCompression::kPxr24)->TILE_ROWS;

}  // namespace

BENCHMARK_MAIN();
