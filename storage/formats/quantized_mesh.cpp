// Layout: header, vertex deltas (zig-zag), indices (high-water mark), four edge lists, extensions. All
// little-endian.

#include "storage/formats/quantized_mesh.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>

namespace lodestone {
namespace {

constexpr int kMax = 32767;
constexpr std::size_t kHeaderBytes = 88;
enum Extension : std::uint8_t { kOctNormals = 1, kWatermask = 2, kMetadata = 4 };

double length(const Vec3& a) { return std::sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]); }
double dot(const Vec3& a, const Vec3& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
Vec3 cross(const Vec3& a, const Vec3& b) {
  return {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
}

// Point on the line from the Earth's centre through `centre` that is below the horizon only when every
// position is; scaled so that the ellipsoid is the unit sphere. A tile of half the Earth has no such point
// and gets one far out.
Vec3 horizon_occlusion_point(const std::vector<Vec3>& positions, std::size_t count, const Vec3& centre) {
  constexpr Vec3 kRadii{6378137.0, 6378137.0, 6356752.3142451793};
  constexpr double kFarOut = 1e6;
  const auto scaled = [&](const Vec3& p) {
    return Vec3{p[0] / kRadii[0], p[1] / kRadii[1], p[2] / kRadii[2]};
  };
  Vec3 direction = scaled(centre);
  const double size = length(direction);
  if (size <= 0) return {kFarOut, 0, 0};
  for (double& x : direction) x /= size;
  double magnitude = 0;
  for (std::size_t i = 0; i < count; ++i) {
    Vec3 p = scaled(positions[i]);
    const double m = length(p);
    for (double& x : p) x /= m;
    const double above =
        std::max(m, 1.0);  // a point below the ellipsoid is hidden sooner than the one above it
    const double cos_alpha = dot(p, direction), sin_alpha = length(cross(p, direction));
    const double cos_beta = 1 / above, sin_beta = std::sqrt(above * above - 1) * cos_beta;
    const double denominator = cos_alpha * cos_beta - sin_alpha * sin_beta;
    magnitude = denominator > 1 / kFarOut ? std::max(magnitude, 1 / denominator) : kFarOut;
    if (magnitude >= kFarOut) break;
  }
  magnitude = std::min(magnitude, kFarOut);
  return {direction[0] * magnitude, direction[1] * magnitude, direction[2] * magnitude};
}

struct Quantizer {
  const TinMesh& mesh;
  const GeodeticFrame& frame;
  std::array<float, 2> range;

  int u(const TinVertex& p) const {
    return static_cast<int>(std::floor(static_cast<double>(p.col) * kMax / (mesh.cols - 1) + 0.5));
  }
  double v_exact(const TinVertex& p) const {
    const double share = static_cast<double>(p.row) / (mesh.rows - 1);
    if (!frame.is_mercator) return kMax * (1 - share);
    return kMax * (latitude_deg(frame, share) - frame.south_deg) / (frame.north_deg - frame.south_deg);
  }
  int v(const TinVertex& p) const {
    return std::clamp(static_cast<int>(std::floor(v_exact(p) + 0.5)), 0, kMax);
  }
  int height(const TinVertex& p) const {
    const double span = static_cast<double>(range[1]) - range[0];
    return span > 0 ? std::clamp(static_cast<int>(std::floor(
                                     (p.height_m - static_cast<double>(range[0])) / span * kMax + 0.5)),
                                 0, kMax)
                    : 0;
  }
};

class Writer {
 public:
  template <class T>
  void put(T value) {
    static_assert(std::is_trivially_copyable_v<T>);
    bytes_.append(reinterpret_cast<const char*>(&value), sizeof value);
  }
  void put(const Vec3& p) {
    for (const double x : p) put(x);
  }
  void index(std::uint32_t i, bool is_wide) { is_wide ? put(i) : put(static_cast<std::uint16_t>(i)); }
  std::string bytes_;
};

}  // namespace

std::array<std::uint8_t, 2> oct_encoded(const Vec3& n) {
  const double sum = std::abs(n[0]) + std::abs(n[1]) + std::abs(n[2]);
  double x = n[0] / sum, y = n[1] / sum;
  if (n[2] < 0) {
    const double old_x = x;
    x = (1 - std::abs(y)) * (old_x < 0 ? -1 : 1);
    y = (1 - std::abs(old_x)) * (y < 0 ? -1 : 1);
  }
  const auto byte = [](double a) {
    return static_cast<std::uint8_t>(std::floor((std::clamp(a, -1.0, 1.0) * 0.5 + 0.5) * 255 + 0.5));
  };
  return {byte(x), byte(y)};
}

Vec3 oct_decoded(std::uint8_t bx, std::uint8_t by) {
  Vec3 n{bx / 255.0 * 2 - 1, by / 255.0 * 2 - 1, 0};
  n[2] = 1 - std::abs(n[0]) - std::abs(n[1]);
  if (n[2] < 0) {
    const double old_x = n[0];
    n[0] = (1 - std::abs(n[1])) * (old_x < 0 ? -1 : 1);
    n[1] = (1 - std::abs(old_x)) * (n[1] < 0 ? -1 : 1);
  }
  const double size = length(n);
  return {n[0] / size, n[1] / size, n[2] / size};
}

Result<std::string> encode_quantized_mesh(const TinMesh& mesh, const QuantizedMeshOptions& options) {
  const auto refuse = [](const std::string& what) {
    return Error{ErrorCode::kInvalidArgument, "quantized-mesh: " + what};
  };
  if (mesh.top_triangles == 0) return refuse("the mesh has no triangles");
  if (options.has_normals && mesh.normals.size() < 3 * mesh.top_vertices)
    return refuse("normals were asked for, the mesh has none; call set_normals first");
  if (options.watermask && options.watermask->size() != 1 && options.watermask->size() != 65536) {
    return refuse("a watermask has 1 or 65536 bytes, found " + std::to_string(options.watermask->size()));
  }
  const GeodeticFrame& frame = options.frame;

  // Vertices in the order of their first use, which is what the high-water mark encodes.
  constexpr std::uint32_t kUnseen = std::numeric_limits<std::uint32_t>::max();
  std::vector<std::uint32_t> number(mesh.top_vertices, kUnseen), order;
  order.reserve(mesh.top_vertices);
  for (std::size_t k = 0; k < 3 * mesh.top_triangles; ++k) {
    std::uint32_t& n = number[mesh.triangles[k]];
    if (n != kUnseen) continue;
    n = static_cast<std::uint32_t>(order.size());
    order.push_back(mesh.triangles[k]);
  }
  const bool is_wide = order.size() > 65536;
  const Quantizer q{mesh, frame, height_range(mesh)};

  Writer out;
  const std::vector<Vec3> positions = ecef_positions(mesh, frame);
  Vec3 low = positions[order[0]], high = low;
  for (const std::uint32_t v : order) {
    for (std::size_t i = 0; i < 3; ++i) {
      low[i] = std::min(low[i], positions[v][i]);
      high[i] = std::max(high[i], positions[v][i]);
    }
  }
  const Vec3 sphere_centre{(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2};
  double radius = 0;
  for (const std::uint32_t v : order) {
    const Vec3& p = positions[v];
    radius =
        std::max(radius, length({p[0] - sphere_centre[0], p[1] - sphere_centre[1], p[2] - sphere_centre[2]}));
  }
  radius += quantized_mesh_slack_m(mesh, frame);  // decoded vertices lie beside the exact ones
  const Vec3 centre =
      ecef_from_geodetic((frame.west_deg + frame.east_deg) / 2, (frame.south_deg + frame.north_deg) / 2,
                         (static_cast<double>(q.range[0]) + q.range[1]) / 2);
  out.put(centre);
  out.put(q.range[0]);
  out.put(q.range[1]);
  out.put(sphere_centre);
  out.put(radius);
  out.put(horizon_occlusion_point(positions, mesh.top_vertices, sphere_centre));

  out.put(static_cast<std::uint32_t>(order.size()));
  const auto put_deltas = [&](auto&& value) {
    int before = 0;
    for (const std::uint32_t v : order) {
      const int now = value(mesh.vertices[v]), delta = now - before;
      out.put(static_cast<std::uint16_t>((delta << 1) ^ (delta >> 31)));
      before = now;
    }
  };
  put_deltas([&](const TinVertex& p) { return q.u(p); });
  put_deltas([&](const TinVertex& p) { return q.v(p); });
  put_deltas([&](const TinVertex& p) { return q.height(p); });

  while (is_wide && out.bytes_.size() % 4 != 0) out.bytes_.push_back('\0');
  out.put(static_cast<std::uint32_t>(mesh.top_triangles));
  std::uint32_t highest = 0;
  for (std::size_t k = 0; k < 3 * mesh.top_triangles; ++k) {
    const std::uint32_t n = number[mesh.triangles[k]];
    out.index(highest - n, is_wide);
    if (n == highest) ++highest;
  }
  const TinBorder border = border_of(mesh);
  for (const std::vector<std::uint32_t>* side : {&border.west, &border.south, &border.east, &border.north}) {
    std::uint32_t count = 0;
    for (const std::uint32_t v : *side) count += number[v] != kUnseen;
    out.put(count);
    for (const std::uint32_t v : *side) {
      if (number[v] != kUnseen) out.index(number[v], is_wide);
    }
  }

  const auto begin_extension = [&](Extension id, std::size_t size) {
    out.put(static_cast<std::uint8_t>(id));
    out.put(static_cast<std::uint32_t>(size));
  };
  if (options.has_normals) {
    begin_extension(kOctNormals, 2 * order.size());
    for (const std::uint32_t v : order) {
      const TinVertex& p = mesh.vertices[v];
      const double lon = frame.west_deg + (frame.east_deg - frame.west_deg) * p.col / (mesh.cols - 1);
      const double lat = latitude_deg(frame, static_cast<double>(p.row) / (mesh.rows - 1));
      for (const std::uint8_t b : oct_encoded(ecef_from_enu(
               lon, lat, {mesh.normals[3 * v], mesh.normals[3 * v + 1], mesh.normals[3 * v + 2]})))
        out.put(b);
    }
  }
  if (options.watermask) {
    begin_extension(kWatermask, options.watermask->size());
    out.bytes_.append(options.watermask->begin(), options.watermask->end());
  }
  if (!options.metadata_json.empty()) {
    begin_extension(kMetadata, 4 + options.metadata_json.size());
    out.put(static_cast<std::uint32_t>(options.metadata_json.size()));
    out.bytes_ += options.metadata_json;
  }
  return std::move(out.bytes_);
}

namespace {

// A triangle that is flat in latitude is bent in Mercator rows: by how many rows at most between rows `top`
// and `bottom`, with the rounding of move_y mean rows.
double mercator_rows_off(const Quantizer& q, std::int32_t top, std::int32_t bottom, double move_y) {
  const auto v = [&](double row) {
    return (latitude_deg(q.frame, row / (q.mesh.rows - 1)) - q.frame.south_deg) /
           (q.frame.north_deg - q.frame.south_deg) * (q.mesh.rows - 1);
  };
  const double bend = std::abs(v((top + bottom) / 2.0) - (v(top) + v(bottom)) / 2);
  const double thinnest =
      std::min(v(top) - v(top + 0.5), v(bottom - 0.5) - v(bottom)) * 2;  // mean rows in one row
  return (1.2 * bend + move_y) / thinnest;
}

}  // namespace

double quantized_mesh_slack_m(const TinMesh& mesh, const GeodeticFrame& frame) {
  if (mesh.top_triangles == 0) return 0;
  const Quantizer q{mesh, frame, height_range(mesh)};
  // Vertices move by at most these parts of a post; rows of Mercator tiles are compared in latitude, so per
  // post row.
  double move_x = 0, move_y = 0;
  for (std::size_t v = 0; v < mesh.top_vertices; ++v) {
    const TinVertex& p = mesh.vertices[v];
    move_x = std::max(move_x, std::abs(static_cast<double>(q.u(p)) * (mesh.cols - 1) / kMax - p.col));
    move_y = std::max(move_y, std::abs(q.v(p) - q.v_exact(p)) * (mesh.rows - 1) / kMax);
  }
  double steepest = 0;
  for (std::size_t t = 0; t < mesh.top_triangles; ++t) {
    const TinVertex &a = mesh.vertices[mesh.triangles[3 * t]], &b = mesh.vertices[mesh.triangles[3 * t + 1]],
                    &c = mesh.vertices[mesh.triangles[3 * t + 2]];
    const double bx = b.col - a.col, by = b.row - a.row, bz = static_cast<double>(b.height_m) - a.height_m;
    const double cx = c.col - a.col, cy = c.row - a.row, cz = static_cast<double>(c.height_m) - a.height_m;
    const double area2 = bx * cy - cx * by;
    const double rows_off = frame.is_mercator ? mercator_rows_off(q, std::min({a.row, b.row, c.row}),
                                                                  std::max({a.row, b.row, c.row}), move_y)
                                              : move_y;
    steepest = std::max(steepest, std::abs((bz * cy - cz * by) / area2) * move_x +
                                      std::abs((bx * cz - cx * bz) / area2) * rows_off);
  }
  return (static_cast<double>(q.range[1]) - q.range[0]) / kMax / 2 + steepest;
}

namespace {

// Reads little-endian values; past the end it returns zeros and remembers.
class Reader {
 public:
  explicit Reader(std::span<const std::uint8_t> bytes) : bytes_(bytes) {}
  template <class T>
  T get() {
    T value{};
    if (sizeof value > left()) {
      is_short_ = true;
      at_ = bytes_.size();
    } else {
      std::memcpy(&value, bytes_.data() + at_, sizeof value);
      at_ += sizeof value;
    }
    return value;
  }
  Vec3 vec3() { return {get<double>(), get<double>(), get<double>()}; }
  std::uint32_t index(bool is_wide) { return is_wide ? get<std::uint32_t>() : get<std::uint16_t>(); }
  std::size_t left() const { return bytes_.size() - at_; }
  std::size_t at() const { return at_; }
  bool is_short() const { return is_short_; }
  std::span<const std::uint8_t> take(std::size_t n) {
    const auto part = bytes_.subspan(at_, n);
    at_ += n;
    return part;
  }

 private:
  std::span<const std::uint8_t> bytes_;
  std::size_t at_ = 0;
  bool is_short_ = false;
};

}  // namespace

Result<DecodedQuantizedMesh> decode_quantized_mesh(std::span<const std::uint8_t> bytes,
                                                   std::size_t max_vertices) {
  const auto corrupt = [](const std::string& what) {
    return Error{ErrorCode::kCorrupt, "quantized-mesh: " + what};
  };
  Reader in(bytes);
  if (bytes.size() < kHeaderBytes + 4)
    return corrupt(std::to_string(bytes.size()) + " bytes are too few for a header");
  DecodedQuantizedMesh mesh;
  mesh.centre = in.vec3();
  mesh.height_min_m = in.get<float>();
  mesh.height_max_m = in.get<float>();
  mesh.sphere_centre = in.vec3();
  mesh.sphere_radius = in.get<double>();
  mesh.horizon_occlusion = in.vec3();

  const std::size_t count = in.get<std::uint32_t>();
  if (count > max_vertices)
    return Error{ErrorCode::kTooLarge, "quantized-mesh: " + std::to_string(count) + " vertices, at most " +
                                           std::to_string(max_vertices)};
  if (count < 3 || 6 * count > in.left())
    return corrupt(std::to_string(count) + " vertices in " + std::to_string(bytes.size()) + " bytes");
  for (std::vector<std::uint16_t>* values : {&mesh.u, &mesh.v, &mesh.height}) {
    values->reserve(count);
    int value = 0;
    for (std::size_t i = 0; i < count; ++i) {
      const int code = in.get<std::uint16_t>();
      value += (code >> 1) ^ -(code & 1);
      if (value < 0 || value > kMax) return corrupt("vertex " + std::to_string(i) + " lies outside 0..32767");
      values->push_back(static_cast<std::uint16_t>(value));
    }
  }

  const bool is_wide = count > 65536;
  const std::size_t index_bytes = is_wide ? 4 : 2;
  while (is_wide && in.at() % 4 != 0) in.get<std::uint8_t>();
  const std::size_t triangles = in.get<std::uint32_t>();
  if (triangles > 4 * max_vertices)
    return Error{ErrorCode::kTooLarge, "quantized-mesh: " + std::to_string(triangles) + " triangles"};
  if (in.is_short() || triangles == 0 || 3 * triangles > in.left() / index_bytes)
    return corrupt(std::to_string(triangles) + " triangles do not fit");
  std::uint32_t highest = 0;
  mesh.indices.reserve(3 * triangles);
  for (std::size_t k = 0; k < 3 * triangles; ++k) {
    const std::uint32_t code = in.index(is_wide);
    if (code > highest || highest - code >= count)
      return corrupt("index " + std::to_string(k) + " refers to no vertex");
    mesh.indices.push_back(highest - code);
    if (code == 0) ++highest;
  }
  for (std::vector<std::uint32_t>* side : {&mesh.west, &mesh.south, &mesh.east, &mesh.north}) {
    const std::size_t n = in.get<std::uint32_t>();
    if (in.is_short() || n > in.left() / index_bytes)
      return corrupt("an edge list of " + std::to_string(n) + " does not fit");
    side->reserve(n);
    for (std::size_t i = 0; i < n; ++i) {
      side->push_back(in.index(is_wide));
      if (side->back() >= count) return corrupt("an edge list refers to no vertex");
    }
  }
  while (in.left() > 0) {
    const auto id = in.get<std::uint8_t>();
    const std::size_t size = in.get<std::uint32_t>();
    if (in.is_short() || size > in.left())
      return corrupt("extension " + std::to_string(id) + " of " + std::to_string(size) +
                     " bytes does not fit");
    const std::span<const std::uint8_t> body = in.take(size);
    if (id == kOctNormals) {
      if (size != 2 * count)
        return corrupt("normals for " + std::to_string(size / 2) + " of " + std::to_string(count) +
                       " vertices");
      mesh.oct_normals.assign(body.begin(), body.end());
    } else if (id == kWatermask) {
      if (size != 1 && size != 65536) return corrupt("a watermask of " + std::to_string(size) + " bytes");
      mesh.watermask.assign(body.begin(), body.end());
    } else if (id == kMetadata) {
      std::uint32_t json_size = 0;
      if (size >= 4) std::memcpy(&json_size, body.data(), 4);
      if (size < 4 || json_size != size - 4) return corrupt("metadata of a wrong length");
      mesh.metadata_json.assign(body.begin() + 4, body.end());
    }
  }
  return mesh;
}

}  // namespace lodestone
