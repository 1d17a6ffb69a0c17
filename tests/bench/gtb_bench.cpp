// Geometric-Textured Bitree: time per stage, triangles a second, bytes beside JPEG 2000, PNG16, LERC of one run.
// Uses the DEMs beside the checkout where they are, generated terrain else. LODESTONE_BENCH_DATA names their folder.

#include <benchmark/benchmark.h>
#include <cpl_vsi.h>
#include <gdal_priv.h>

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <map>

#include "kernels/texture/gtb_model.h"
#include "kernels/texture/texture_synthesis.h"
#include "storage/formats/gtb.h"
#include "tests/support/gtb_samples.h"

namespace lodestone {
namespace {

// The largest 2^n + 1 window (at most `posts`) of a DEM, whole metres; terrain where the file is missing.
std::vector<float> heights_of(const std::string& name, int& posts) {
  const char* const folder = std::getenv("LODESTONE_BENCH_DATA");
  const std::string path = std::string(folder != nullptr ? folder : "../shared/data") + "/" + name;
  GDALAllRegister();
  std::vector<float> heights;
  if (std::filesystem::exists(path)) {
    if (auto* const dem = static_cast<GDALDataset*>(GDALOpen(path.c_str(), GA_ReadOnly)); dem != nullptr) {
      while (posts > std::min(dem->GetRasterXSize(), dem->GetRasterYSize())) posts = (posts - 1) / 2 + 1;
      heights.resize(static_cast<std::size_t>(posts) * static_cast<std::size_t>(posts));
      const int x = (dem->GetRasterXSize() - posts) / 2, y = (dem->GetRasterYSize() - posts) / 2;
      if (dem->GetRasterBand(1)->RasterIO(GF_Read, x, y, posts, posts, heights.data(), posts, posts, GDT_Float32, 0, 0) != CE_None) heights.clear();
      GDALClose(dem);
      for (float& h : heights) h = h < -500 || h > 9000 ? 0 : std::floor(h + 0.5F);
    }
  }
  return heights.empty() ? test::heights_of(test::Kind::kInteger, 0, 0, posts, posts, 0, 1) : heights;
}

BitreeRequest lossless(const std::vector<float>& heights, int posts) {
  BitreeRequest request;
  request.field = {heights, {}, posts, posts, 0};
  request.max_error_m = 0;
  return request;
}

// Bytes of the same posts as GDAL writes them (UInt16, metres above the lowest); 0 without the driver.
std::size_t gdal_bytes(const char* driver_name, const std::vector<float>& heights, int posts, std::vector<const char*> options, std::vector<std::uint8_t>* keep = nullptr) {
  auto* const driver = GetGDALDriverManager()->GetDriverByName(driver_name);
  auto* const memory = GetGDALDriverManager()->GetDriverByName("MEM");
  if (driver == nullptr || memory == nullptr) return 0;
  const float lowest = *std::min_element(heights.begin(), heights.end());
  std::vector<std::uint16_t> values;
  for (const float h : heights) values.push_back(static_cast<std::uint16_t>(h - lowest));
  auto* const source = memory->Create("", posts, posts, 1, GDT_UInt16, nullptr);
  if (source->GetRasterBand(1)->RasterIO(GF_Write, 0, 0, posts, posts, values.data(), posts, posts, GDT_UInt16, 0, 0) != CE_None) return 0;
  options.push_back(nullptr);
  const char* const path = "/vsimem/gtb_bench";
  auto* const made = driver->CreateCopy(path, source, FALSE, const_cast<char**>(options.data()), nullptr, nullptr);
  if (made != nullptr) GDALClose(made);
  GDALClose(source);
  vsi_l_offset size = 0;
  const GByte* const bytes = VSIGetMemFileBuffer(path, &size, FALSE);
  if (keep != nullptr && bytes != nullptr) keep->assign(bytes, bytes + size);
  VSIUnlink(path);
  return size;
}
const std::vector<const char*> kJpeg2000{"REVERSIBLE=YES", "QUALITY=100", "CODEC=J2K"};

void sizes(benchmark::State& state, const std::string& name, int wanted) {
  int posts = wanted;
  const std::vector<float> heights = heights_of(name, posts);
  const BitreeRequest request = lossless(heights, posts);
  const Result<Bitree> tree = build_bitree(request);
  std::string bytes;
  for (auto _ : state) {
    bytes = encode_gtb(encode_gtb_model(&*tree, nullptr));
    benchmark::DoNotOptimize(bytes);
  }
  const auto bound = [&](double error) {
    BitreeRequest bounded = request;
    bounded.max_error_m = error;
    bounded.z_step_m = error;
    Result<Bitree> t = build_bitree(bounded);
    return std::pair{static_cast<double>(encode_gtb(encode_gtb_model(&*t, nullptr)).size()), *t};
  };
  const auto [bytes4, tree4] = bound(4);
  const double triangles4 = static_cast<double>(bitree_mesh(tree4).triangle_count());
  const double jpeg2000 = static_cast<double>(gdal_bytes("JP2OpenJPEG", heights, posts, kJpeg2000)), png = static_cast<double>(gdal_bytes("PNG", heights, posts, {"ZLEVEL=9"}));
  const double lerc = static_cast<double>(gdal_bytes("GTiff", heights, posts, {"COMPRESS=LERC", "MAX_Z_ERROR=4", "TILED=NO", "BLOCKYSIZE=8192"}));
  BitreeRequest wavelet = request;
  wavelet.max_error_m.reset();
  wavelet.threshold_m = 0;
  wavelet.is_edge_shared = false;
  const Result<Bitree> paper = build_bitree(wavelet);
  const BitreeError paper_error = measure_bitree_error(*paper, request.field);
  const double all = static_cast<double>(posts) * posts;
  state.counters["posts"] = posts;
  state.counters["bytes"] = static_cast<double>(bytes.size());
  if (jpeg2000 > 0) state.counters["to_jp2"] = static_cast<double>(bytes.size()) / jpeg2000;
  if (png > 0) state.counters["to_png16"] = static_cast<double>(bytes.size()) / png;
  if (lerc > 0) state.counters["E4_to_lerc"] = bytes4 / lerc;
  BitreeRequest complete = request;   // all posts kept: no states to tell, the most triangles
  complete.keeps_all = true;
  const Result<Bitree> every = build_bitree(complete);
  if (jpeg2000 > 0) state.counters["all_to_jp2"] = static_cast<double>(encode_gtb(encode_gtb_model(&*every, nullptr)).size()) / jpeg2000;
  if (png > 0) state.counters["all_to_png16"] = static_cast<double>(encode_gtb(encode_gtb_model(&*every, nullptr)).size()) / png;
  state.counters["E4_kept"] = static_cast<double>(tree4.selected) / all;
  state.counters["E4_bits_per_tri"] = 8 * bytes4 / triangles4;
  state.counters["T0_kept"] = static_cast<double>(paper->selected) / all;
  state.counters["T0_fictitious"] = static_cast<double>(paper->fictitious) / all;
  state.counters["T0_nrmse"] = paper_error.rms_normalised;
}
BENCHMARK_CAPTURE(sizes, bigtujunga, "bigtujunga/bigtujunga_30m.tif", 1025)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sizes, portland, "portland/portland_ned.tif", 1025)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sizes, gabilan, "gabilan/gabilan_1m.tif", 1025)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sizes, canberra, "canberra/S36E149_srtm3.tif", 1025)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(sizes, narok, "narok_large/narok_1.4arcsec.tif", 4097)->Unit(benchmark::kMillisecond)->Iterations(1);

// Speed on one 1025-post DEM, beside OpenJPEG in the same run.
const char* const kSpeedDem = "canberra/S36E149_srtm3.tif";
void BM_Encode(benchmark::State& state) {
  int posts = static_cast<int>(state.range(0));
  const std::vector<float> heights = heights_of(kSpeedDem, posts);
  std::size_t bytes = 0;
  for (auto _ : state) {
    BitreeRequest request = lossless(heights, posts);
    request.keeps_all = true;
    const Result<Bitree> tree = build_bitree(request);
    bytes = encode_gtb(encode_gtb_model(&*tree, nullptr)).size();
  }
  state.counters["bytes"] = static_cast<double>(bytes);
}
void BM_Decode(benchmark::State& state) {
  int posts = static_cast<int>(state.range(0));
  const std::vector<float> heights = heights_of(kSpeedDem, posts);
  BitreeRequest request = lossless(heights, posts);
  request.keeps_all = true;
  const Result<Bitree> tree = build_bitree(request);
  const std::string text = encode_gtb(encode_gtb_model(&*tree, nullptr));
  const std::vector<std::uint8_t> bytes(text.begin(), text.end());
  for (auto _ : state) {
    const Result<GtbPrefix> prefix = decode_gtb(bytes);
    Result<GtbModelDecoder> model = GtbModelDecoder::open(prefix->stream.header);
    for (const GtbChunk& chunk : prefix->stream.chunks) {
      if (!model->accept(chunk)) state.SkipWithError("stream refused");
    }
    benchmark::DoNotOptimize(model->is_complete());
  }
  state.counters["triangles"] = benchmark::Counter(static_cast<double>(bitree_mesh(*tree).triangle_count()), benchmark::Counter::kIsIterationInvariantRate);
}
void BM_FirstBytes(benchmark::State& state) {   // heights there -> header, metadata and the first chunk
  int posts = 257;
  const std::vector<float> heights = heights_of(kSpeedDem, posts);
  BitreeRequest request = lossless(heights, posts);
  request.max_error_m = 4;
  for (auto _ : state) {
    const Result<Bitree> tree = build_bitree(request);
    const BitreeError error = measure_bitree_error(*tree, request.field);
    GtbModelEncoder encoder(&*tree, nullptr);
    const std::string first = gtb_header_bytes(encoder.header()) + gtb_metadata_bytes({error.max_m, error.rms_m, bitree_error_bounds(*tree, error.max_m), {}}) + gtb_chunk_bytes(*encoder.next());
    benchmark::DoNotOptimize(first);
  }
}
void BM_OpenJpegEncode(benchmark::State& state) {
  int posts = static_cast<int>(state.range(0));
  const std::vector<float> heights = heights_of(kSpeedDem, posts);
  CPLSetConfigOption("GDAL_NUM_THREADS", "1");
  std::size_t bytes = 0;
  for (auto _ : state) bytes = gdal_bytes("JP2OpenJPEG", heights, posts, kJpeg2000);
  state.counters["bytes"] = static_cast<double>(bytes);
}
void BM_OpenJpegDecode(benchmark::State& state) {
  int posts = static_cast<int>(state.range(0));
  const std::vector<float> heights = heights_of(kSpeedDem, posts);
  CPLSetConfigOption("GDAL_NUM_THREADS", "1");
  std::vector<std::uint8_t> bytes;
  gdal_bytes("JP2OpenJPEG", heights, posts, kJpeg2000, &bytes);
  std::vector<std::uint16_t> values(heights.size());
  for (auto _ : state) {
    VSIFCloseL(VSIFileFromMemBuffer("/vsimem/gtb_bench.j2k", bytes.data(), bytes.size(), FALSE));
    auto* const image = static_cast<GDALDataset*>(GDALOpen("/vsimem/gtb_bench.j2k", GA_ReadOnly));
    if (image == nullptr || image->GetRasterBand(1)->RasterIO(GF_Read, 0, 0, posts, posts, values.data(), posts, posts, GDT_UInt16, 0, 0) != CE_None) {
      state.SkipWithError("no JPEG 2000 reader");
    }
    if (image != nullptr) GDALClose(image);
    VSIUnlink("/vsimem/gtb_bench.j2k");
  }
}
BENCHMARK(BM_Encode)->ArgName("posts")->Arg(257)->Arg(1025)->Unit(benchmark::kMillisecond);
BENCHMARK(BM_Decode)->ArgName("posts")->Arg(257)->Arg(1025)->Unit(benchmark::kMillisecond);
BENCHMARK(BM_FirstBytes)->Unit(benchmark::kMillisecond);
BENCHMARK(BM_OpenJpegEncode)->ArgName("posts")->Arg(1025)->Unit(benchmark::kMillisecond);
BENCHMARK(BM_OpenJpegDecode)->ArgName("posts")->Arg(1025)->Unit(benchmark::kMillisecond);

// Texture: classes before and after, bytes at shares of the triangles.
RgbImage image_of(const std::string& name, std::vector<int> bands) {
  const char* const folder = std::getenv("LODESTONE_BENCH_DATA");
  const std::string path = std::string(folder != nullptr ? folder : "../shared/data") + "/" + name;
  GDALAllRegister();
  if (!std::filesystem::exists(path)) return test::patchy_image(536, 536);
  auto* const file = static_cast<GDALDataset*>(GDALOpen(path.c_str(), GA_ReadOnly));
  const int width = file->GetRasterXSize(), height = file->GetRasterYSize();
  RgbImage image{width, height, std::vector<std::uint8_t>(3 * static_cast<std::size_t>(width) * static_cast<std::size_t>(height))};
  for (std::size_t c = 0; c < 3; ++c) {   // 2..98 % stretch to 8 bits
    std::vector<float> values(image.rgb.size() / 3);
    if (file->GetRasterBand(bands[c])->RasterIO(GF_Read, 0, 0, width, height, values.data(), width, height, GDT_Float32, 0, 0) != CE_None) break;
    std::vector<float> sorted = values;
    std::sort(sorted.begin(), sorted.end());
    const float low = sorted[sorted.size() / 50], high = std::max(sorted[sorted.size() - 1 - sorted.size() / 50], low + 1);
    for (std::size_t at = 0; at < values.size(); ++at) image.rgb[3 * at + c] = static_cast<std::uint8_t>(std::clamp(255 * (values[at] - low) / (high - low), 0.0F, 255.0F));
  }
  GDALClose(file);
  return image;
}
void texture(benchmark::State& state, const std::string& name, const std::vector<int>& bands, double share) {
  const RgbImage image = image_of(name, bands);
  Result<TextureSegmentation> segmentation = segment_texture(image);
  const TextureModel model = *texture_model_of(*segmentation, share);
  const double triangles = static_cast<double>(count_texture_triangles(model.tree).visited);
  std::size_t bytes = 0;
  GtbStream stream;
  for (auto _ : state) {
    stream = encode_gtb_model(nullptr, &model);
    bytes = encode_gtb(stream).size();
  }
  std::map<double, double> at_share;
  double seen = 0, sent = static_cast<double>(kGtbHeaderBytes), patterns = 0;
  for (const GtbChunk& chunk : stream.chunks) {
    sent += static_cast<double>(gtb_chunk_bytes(chunk).size());
    if (chunk.type == GtbChunkType::kPattern) patterns += static_cast<double>(gtb_chunk_bytes(chunk).size());
    if (chunk.type == GtbChunkType::kTexture) seen += chunk.count;
    for (const double percent : {1.5, 5.0, 15.0, 75.0}) {
      if (seen >= percent / 100 * triangles && at_share.count(percent) == 0) at_share[percent] = sent;
    }
  }
  state.counters["classes_before"] = static_cast<double>(segmentation->classes_before);
  state.counters["classes"] = static_cast<double>(segmentation->means.size());
  state.counters["triangles"] = triangles;
  state.counters["bytes"] = static_cast<double>(bytes);
  state.counters["token_bits_per_tri"] = 8 * (static_cast<double>(bytes) - patterns) / triangles;
  state.counters["bits_per_tri"] = 8 * static_cast<double>(bytes) / triangles;
  for (const auto& [percent, size] : at_share) state.counters["bytes_at_" + std::to_string(percent).substr(0, 4)] = size;
}
BENCHMARK_CAPTURE(texture, kanto_exact, "kanto_landsat/landsat8_rgb_536.tif", {1, 2, 3}, 1.0)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(texture, kanto_90, "kanto_landsat/landsat8_rgb_536.tif", {1, 2, 3}, 0.9)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(texture, canberra_exact, "canberra/landsat5_nbar_6band.tif", {3, 2, 1}, 1.0)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(texture, autzen_exact, "autzen/autzen_rgb_1m.tif", {1, 2, 3}, 1.0)->Unit(benchmark::kMillisecond)->Iterations(1);

// Correlation of an image's luminance with itself, `lag` pixels to the east, south mean; 1 for a pattern repeated at that lag.
double autocorrelation(const RgbImage& image, int lag) {
  const auto value = [&](int row, int col) { return image.rgb[image.index(row, col)] + image.rgb[image.index(row, col) + 1] + image.rgb[image.index(row, col) + 2]; };
  double sum = 0, sum2 = 0, east = 0, south = 0;
  for (int row = 0; row < image.height; ++row) {
    for (int col = 0; col < image.width; ++col) {
      const double v = value(row, col);
      sum += v;
      sum2 += v * v;
      east += v * value(row, (col + lag) % image.width);
      south += v * value((row + lag) % image.height, col);
    }
  }
  const double count = static_cast<double>(image.rgb.size()) / 3, mean2 = sum * sum / count;
  return sum2 > mean2 ? ((east + south) / 2 - mean2) / (sum2 - mean2) : 0;
}
// Histogram distance (half the sum of differences per channel) of an image to the pixels of one class.
double histogram_distance(const RgbImage& texture, const RgbImage& image, const std::vector<std::uint8_t>& classes, std::size_t k) {
  double distance = 0;
  for (std::size_t c = 0; c < 3; ++c) {
    std::vector<double> ours(256, 0), theirs(256, 0);
    double pixels = 0;
    for (std::size_t at = 0; at < classes.size(); ++at) {
      if (classes[at] == k) theirs[image.rgb[3 * at + c]] += 1, pixels += 1;
    }
    for (std::size_t at = c; at < texture.rgb.size(); at += 3) ours[texture.rgb[at]] += 3.0 / static_cast<double>(texture.rgb.size());
    for (std::size_t v = 0; v < 256; ++v) distance += std::abs(ours[v] - theirs[v] / pixels) / 6;
  }
  return distance;
}
void BM_Synthesis(benchmark::State& state) {
  const RgbImage image = image_of("kanto_landsat/landsat8_rgb_536.tif", {1, 2, 3});
  const Result<TextureSegmentation> segmentation = segment_texture(image);
  const auto mode = static_cast<PermutationMode>(state.range(0));
  std::vector<RgbImage> textures;
  for (auto _ : state) {
    textures.clear();
    for (std::size_t k = 0; k < segmentation->patterns.size(); ++k) textures.push_back(*synthesise_texture(segmentation->patterns[k], 128, {1, static_cast<std::uint32_t>(k), mode}));
  }
  double weight = 0, correlation = 0, ours = 0, repeated = 0;
  for (std::size_t k = 0; k < textures.size(); ++k) {
    const double size = static_cast<double>(std::count(segmentation->classes.begin(), segmentation->classes.end(), k));
    weight += size;
    correlation += size * autocorrelation(textures[k], segmentation->patterns[k].width);
    ours += size * histogram_distance(textures[k], image, segmentation->classes, k);
    repeated += size * histogram_distance(segmentation->patterns[k], image, segmentation->classes, k);
  }
  state.counters["autocorrelation"] = correlation / weight;
  state.counters["histogram_distance"] = ours / weight;
  state.counters["repeated_distance"] = repeated / weight;
}
BENCHMARK(BM_Synthesis)->ArgName("fifty_swaps")->Arg(0)->Arg(1)->Unit(benchmark::kMillisecond);

void BM_Segment(benchmark::State& state) {
  const RgbImage image = image_of("kanto_landsat/landsat8_rgb_536.tif", {1, 2, 3});
  for (auto _ : state) benchmark::DoNotOptimize(segment_texture(image));
}
BENCHMARK(BM_Segment)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
