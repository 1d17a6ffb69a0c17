#include "service/tiles/tile_maker.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <tuple>

#include "storage/formats/quantum.h"

namespace lodestone {
namespace {

using Clock = std::chrono::steady_clock;

// In lanes, because the compiler may not reorder one running minimum of floats; std::minmax_element costs as much as the kernels.
std::pair<float, float> lowest_and_highest(std::span<const float> heights_m) {
  constexpr std::size_t kLanes = 16;
  std::array<float, kLanes> lowest;
  std::array<float, kLanes> highest;
  lowest.fill(heights_m[0]);
  highest.fill(heights_m[0]);
  std::size_t n = 0;
  for (; n + kLanes <= heights_m.size(); n += kLanes) {
    for (std::size_t lane = 0; lane < kLanes; ++lane) {
      const float h = heights_m[n + lane];
      lowest[lane] = h < lowest[lane] ? h : lowest[lane];
      highest[lane] = h > highest[lane] ? h : highest[lane];
    }
  }
  for (; n < heights_m.size(); ++n) {
    lowest[0] = std::min(lowest[0], heights_m[n]);
    highest[0] = std::max(highest[0], heights_m[n]);
  }
  return {*std::min_element(lowest.begin(), lowest.end()), *std::max_element(highest.begin(), highest.end())};
}

double ms_since(Clock::time_point start) { return std::chrono::duration<double, std::milli>(Clock::now() - start).count(); }

bool is_mesh(const TileKey& key) { return key.format == TileFormat::kGlb || key.format == TileFormat::kTerrain; }

bool needs_halo(const TileKey& key) {
  const bool is_shaded = key.png == PngEncoding::kHillshade || key.png == PngEncoding::kRelief;
  return is_mesh(key) || (key.format == TileFormat::kPng && is_shaded);
}

// Post spacing on the ground at the tile's level, metres.
std::array<double, 2> cell_m(const TileKey& key) {
  const LayerInfo& info = key.layer->info();
  const int up = info.base_level - key.id.z;
  return {std::ldexp(info.cell_x_m, up), std::ldexp(info.cell_y_m, up)};
}

GroundRequest ground_request(const TileKey& key, const TileId& id) { return {key.layer, key.recipe, key.seed, id}; }

// `centre` with one more post on every side, from the neighbours that exist; elsewhere the border post again.
// Errors: those of the neighbours.
Result<std::vector<float>> with_halo(GroundMaker& maker, const TileKey& key, const Ground& centre) {
  const int n = centre.posts;
  const int wide = n + 2;
  std::vector<float> out(static_cast<std::size_t>(wide) * wide);
  for (int row = 0; row < wide; ++row) {
    for (int column = 0; column < wide; ++column) {
      out[static_cast<std::size_t>(row) * wide + column] =
          centre.heights_m[static_cast<std::size_t>(std::clamp(row - 1, 0, n - 1)) * n + std::clamp(column - 1, 0, n - 1)];
    }
  }
  std::vector<GroundRequest> requests;
  std::vector<std::array<int, 2>> steps;
  for (int dy = -1; dy <= 1; ++dy) {
    for (int dx = -1; dx <= 1; ++dx) {
      const TileId id{key.id.z, key.id.x + dx, key.id.y + dy};
      if ((dx == 0 && dy == 0) || id.x < 0 || id.y < 0 || !key.layer->info().has_tile(id)) continue;
      requests.push_back(ground_request(key, id));
      steps.push_back({dx, dy});
    }
  }
  const auto neighbours = maker.make(requests);
  for (std::size_t k = 0; k < neighbours.size(); ++k) {
    if (!neighbours[k]) return neighbours[k].error();  // a tile made without them would be another one
    const auto [dx, dy] = steps[k];
    const std::vector<float>& heights = neighbours[k]->heights_m;
    const int row_first = dy < 0 ? 0 : (dy > 0 ? wide - 1 : 1);
    const int row_last = dy == 0 ? n : row_first;
    const int column_first = dx < 0 ? 0 : (dx > 0 ? wide - 1 : 1);
    const int column_last = dx == 0 ? n : column_first;
    for (int row = row_first; row <= row_last; ++row) {
      for (int column = column_first; column <= column_last; ++column) {
        // Neighbours share their edge post, so the post beyond our edge is the neighbour's second one.
        const int source_row = dy < 0 ? n - 2 : (dy > 0 ? 1 : row - 1);
        const int source_column = dx < 0 ? n - 2 : (dx > 0 ? 1 : column - 1);
        out[static_cast<std::size_t>(row) * wide + column] = heights[static_cast<std::size_t>(source_row) * n + source_column];
      }
    }
  }
  return out;
}

// Largest difference between the served values and the tile's float32 heights, metres.
float max_error_m(const TileKey& key, double highest_m) {
  float error = key.quantum_m / 2;
  if (key.format == TileFormat::kExr && key.exr.pixel == ExrPixel::kHalf) {
    error += static_cast<float>(std::ldexp(1.0, std::max(-24, std::ilogb(std::max(highest_m, 1e-6)) - 11)));
  }
  if (key.format == TileFormat::kExr && key.exr.compression == ExrCompression::kPxr24 && key.exr.pixel == ExrPixel::kFloat) {
    error += static_cast<float>(std::ldexp(1.0, std::max(-126, std::ilogb(std::max(highest_m, 1e-6)) - 16)));
  }
  if (key.format == TileFormat::kPng) error += key.png == PngEncoding::kMapbox ? 0.05F : 1.0F / 512;
  return error;
}

}  // namespace

TileAttributes tile_attributes(const TileKey& key, std::span<const float> heights_m) {
  const LayerInfo& info = key.layer->info();
  TileAttributes a;
  a.layer = info.name;
  a.recipe = key.recipe_name;
  a.revision = key.layer->revision();
  a.crs = info.crs_name;
  a.datum = info.datum;
  a.seed = key.seed;
  a.z = key.id.z;
  a.x = key.id.x;
  a.y = key.id.y;
  const PostWindow window = info.tile_window(key.id);
  const auto origin = info.world_from_post(key.id.z, static_cast<double>(window.i0), static_cast<double>(window.j0));
  a.origin_x = origin[0];
  a.origin_y = origin[1];
  const int up = info.base_level - key.id.z;
  a.spacing_x = std::ldexp(std::hypot(info.transform[1], info.transform[4]), up);
  a.spacing_y = std::ldexp(std::hypot(info.transform[2], info.transform[5]), up);
  std::tie(a.height_min_m, a.height_max_m) = lowest_and_highest(heights_m);
  return a;
}

Result<TileMaker::Made> TileMaker::encode(const TileKey& key, Ground& ground) {
  const LayerInfo& info = key.layer->info();
  Made made;
  std::vector<float> halo;
  if (needs_halo(key)) {
    const auto start = Clock::now();
    auto wide = with_halo(*ground_, key, ground);
    if (!wide) return std::move(wide.error()).within("reading around tile " + to_string(key.id));
    halo = std::move(*wide);
    made.ground_ms = ms_since(start);
  }
  const auto start = Clock::now();
  if (key.quantum_m > 0) {
    if (auto ok = quantise(ground.heights_m, key.quantum_m); !ok) return ok.error();
    if (is_mesh(key)) {
      if (auto ok = quantise(halo, key.quantum_m); !ok) return ok.error();
    }
  }
  Result<std::string> body = std::string();
  double mesh_error_m = 0;
  switch (key.format) {
    case TileFormat::kF32:
      body = encode_f32_tile(ground.heights_m);
      break;
    case TileFormat::kGround:
      body = encode_f32_tile(ground.heights_m);
      body->append(ground.provenance.begin(), ground.provenance.end());
      break;
    case TileFormat::kExr: {
      const std::span<const std::uint8_t> provenance =
          key.has_provenance_channel ? std::span<const std::uint8_t>(ground.provenance) : std::span<const std::uint8_t>();
      body = encode_exr_tile(ground.heights_m, provenance, ground.posts, tile_attributes(key, ground.heights_m), key.exr);
      break;
    }
    case TileFormat::kTif: {
      const PostWindow window = info.tile_window(key.id);
      const auto origin = info.world_from_post(key.id.z, static_cast<double>(window.i0), static_cast<double>(window.j0));
      PostTransform t = info.transform;
      t[0] = origin[0];
      t[3] = origin[1];
      for (const int n : {1, 2, 4, 5}) t[n] = std::ldexp(t[n], info.base_level - key.id.z);
      body = encode_tiff_tile(ground.heights_m, ground.posts, t, info.crs_wkt, tile_attributes(key, ground.heights_m));
      break;
    }
    case TileFormat::kPng: {
      const auto cell = cell_m(key);
      body = encode_png_tile(halo.empty() ? ground.heights_m : halo, ground.posts, halo.empty() ? 0 : 1, key.png, key.png_size, cell[0],
                             cell[1], {info.height_min_m, std::max(info.height_max_m, info.height_min_m + 1)});
      break;
    }
    case TileFormat::kGlb:
    case TileFormat::kTerrain: {
      auto mesh = make_mesh_tile(key, halo, ground.provenance_bits);
      if (mesh) {
        body = std::move(mesh->body);
        mesh_error_m = mesh->max_error_m;
      } else {
        body = mesh.error();
      }
      break;
    }
  }
  if (!body) return std::move(body.error()).within("encoding tile " + to_string(key.id));
  auto tile = std::make_shared<CachedTile>();
  tile->body = std::move(*body);
  tile->provenance = ground.provenance_bits;
  double highest = 0;
  if (key.format == TileFormat::kExr) {
    const auto [lowest_m, highest_m] = lowest_and_highest(ground.heights_m);
    highest = std::max(std::abs(lowest_m), std::abs(highest_m));
  }
  tile->max_error_m = max_error_m(key, highest) + static_cast<float>(mesh_error_m);
  made.tile = std::move(tile);
  made.encode_ms = ms_since(start);
  return made;
}

Result<TileMaker::Made> TileMaker::flat(const TileKey& key) {
  const auto start = Clock::now();
  auto mesh = make_flat_tile(key);
  if (!mesh) return std::move(mesh.error()).within("encoding tile " + to_string(key.id));
  auto tile = std::make_shared<CachedTile>();
  tile->body = std::move(mesh->body);
  tile->max_error_m = static_cast<float>(mesh->max_error_m);
  tile->provenance = 1U << kFilled;
  Made made;
  made.tile = std::move(tile);
  made.encode_ms = ms_since(start);
  return made;
}

std::vector<Result<TileMaker::Made>> TileMaker::make(std::span<const TileKey> keys) {
  const auto start = Clock::now();
  std::vector<GroundRequest> requests;
  for (const TileKey& key : keys) {
    if (!key.mesh.is_flat) requests.push_back(ground_request(key, key.id));
  }
  std::vector<Result<Ground>> grounds = ground_->make(requests);
  const double share_ms = ms_since(start) / static_cast<double>(std::max<std::size_t>(1, keys.size()));
  std::vector<Result<Made>> out;
  std::size_t next = 0;  // of `grounds`
  for (const TileKey& key : keys) {
    if (key.mesh.is_flat) {
      out.push_back(flat(key));
      continue;
    }
    Result<Ground>& ground = grounds[next++];
    if (!ground) {
      out.push_back(ground.error());
      continue;
    }
    auto made = encode(key, *ground);
    if (made) made->ground_ms += share_ms;
    out.push_back(std::move(made));
  }
  return out;
}

}  // namespace lodestone
