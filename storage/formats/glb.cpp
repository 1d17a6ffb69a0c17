// glTF 2.0, section 4 (GLB) and KHR_mesh_quantization.

#include "storage/formats/glb.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <nlohmann/json.hpp>

namespace lodestone {
namespace {

using Json = nlohmann::ordered_json;

constexpr std::uint32_t kMagic = 0x46546C67, kVersion = 2, kJsonChunk = 0x4E4F534A, kBinChunk = 0x004E4942;
enum ComponentType : int { kByte = 5120, kUnsignedShort = 5123, kUnsignedInt = 5125, kFloat = 5126 };
constexpr int kArrayBuffer = 34962, kElementBuffer = 34963;

Error corrupt(const std::string& what) { return {ErrorCode::kCorrupt, "GLB: " + what}; }

// Binary chunk with its buffer views and accessors.
class BinaryWriter {
 public:
  // stride: bytes between elements (a multiple of 4 for vertex data), 0 for indices.
  template <class T>
  int add(const std::vector<T>& values, int components, int component_type, int stride, bool is_normalized,
          bool has_range) {
    while (bytes_.size() % 4 != 0) bytes_.push_back('\0');
    const std::size_t offset = bytes_.size(), count = values.size() / static_cast<std::size_t>(components);
    const std::size_t packed = sizeof(T) * static_cast<std::size_t>(components);
    for (std::size_t i = 0; i < count; ++i) {
      bytes_.append(reinterpret_cast<const char*>(values.data() + i * static_cast<std::size_t>(components)),
                    packed);
      if (stride > 0) bytes_.append(static_cast<std::size_t>(stride) - packed, '\0');
    }
    Json view{{"buffer", 0}, {"byteOffset", offset}, {"byteLength", bytes_.size() - offset}};
    if (stride > 0) view["byteStride"] = stride;
    view["target"] = stride > 0 ? kArrayBuffer : kElementBuffer;
    views_.push_back(view);
    static constexpr std::array<const char*, 4> kTypes{"", "SCALAR", "VEC2", "VEC3"};
    Json accessor{{"bufferView", views_.size() - 1},
                  {"componentType", component_type},
                  {"count", count},
                  {"type", kTypes[static_cast<std::size_t>(components)]}};
    if (is_normalized) accessor["normalized"] = true;
    if (has_range) {
      std::vector<T> low(values.begin(), values.begin() + components), high = low;
      for (std::size_t i = 0; i < values.size(); ++i) {
        T& l = low[i % static_cast<std::size_t>(components)];
        T& h = high[i % static_cast<std::size_t>(components)];
        l = std::min(l, values[i]);
        h = std::max(h, values[i]);
      }
      accessor["min"] = low;
      accessor["max"] = high;
    }
    accessors_.push_back(accessor);
    return static_cast<int>(accessors_.size()) - 1;
  }
  std::string bytes_;
  Json views_ = Json::array(), accessors_ = Json::array();
};

// A primitive's share of the mesh: vertices by their numbers in the whole, triangles by their own.
struct Part {
  int zone = -1;
  std::vector<std::uint32_t> vertices, indices;
  std::vector<float> blend;
};

std::vector<Part> parts_of(const TinMesh& mesh) {
  std::vector<Part> parts;
  if (mesh.zones.empty()) {
    Part whole;
    for (std::uint32_t v = 0; v < mesh.vertices.size(); ++v) whole.vertices.push_back(v);
    whole.indices = mesh.triangles;
    return {std::move(whole)};
  }
  std::map<std::uint16_t, std::vector<std::size_t>> by_zone;
  for (std::size_t t = 0; t < mesh.triangle_count(); ++t) by_zone[mesh.zones[t]].push_back(t);
  constexpr std::uint32_t kUnseen = std::numeric_limits<std::uint32_t>::max();
  std::vector<std::uint32_t> number(mesh.vertices.size(), kUnseen);
  for (const auto& [zone, triangles] : by_zone) {
    Part part;
    part.zone = zone;
    for (const std::size_t t : triangles) {
      for (std::size_t k = 3 * t; k < 3 * t + 3; ++k) {
        std::uint32_t& n = number[mesh.triangles[k]];
        if (n == kUnseen) {
          n = static_cast<std::uint32_t>(part.vertices.size());
          part.vertices.push_back(mesh.triangles[k]);
          if (is_transition(zone) && !mesh.blend.empty()) part.blend.push_back(mesh.blend[k]);
        }
        part.indices.push_back(n);
      }
    }
    for (const std::uint32_t v : part.vertices) number[v] = kUnseen;
    parts.push_back(std::move(part));
  }
  return parts;
}

std::string zone_name(std::uint16_t zone, const GlbOptions& options) {
  if (const auto it = options.zone_names.find(zone); it != options.zone_names.end()) return it->second;
  if (is_transition(zone))
    return "zones " + std::to_string(first_zone(zone)) + "-" + std::to_string(second_zone(zone));
  return "zone " + std::to_string(zone);
}

// A colour that tells zones apart: hues by the golden angle.
std::array<double, 3> zone_colour(int zone) {
  std::array<double, 3> rgb{};
  const double hue = std::fmod(0.13 + zone * 0.6180339887, 1.0) * 6;
  for (int i = 0; i < 3; ++i) {
    const double d = std::abs(std::fmod(hue + 6 - 2 * i, 6.0) - 3) - 1;
    rgb[static_cast<std::size_t>(i)] = std::round((0.35 + 0.4 * std::clamp(d, 0.0, 1.0)) * 1000) / 1000;
  }
  return rgb;
}

Json material_of(const std::string& name, const std::array<double, 3>& rgb) {
  return {{"name", name},
          {"pbrMetallicRoughness",
           {{"baseColorFactor", {rgb[0], rgb[1], rgb[2], 1.0}},
            {"metallicFactor", 0.0},
            {"roughnessFactor", 1.0}}}};
}

struct Lattice {
  double base_m = 0, step_m = 1;  // height = base + step * q
};
Lattice lattice_of(const TinMesh& mesh) {
  float low = mesh.vertices[0].height_m, high = low;
  for (const TinVertex& v : mesh.vertices) {
    low = std::min(low, v.height_m);
    high = std::max(high, v.height_m);
  }
  return {low, high > low ? (static_cast<double>(high) - low) / 65535 : 1};
}

class GlbWriter {
 public:
  GlbWriter(const TinMesh& mesh, const GlbOptions& options) : mesh_(mesh), options_(options) {
    const auto* plane = std::get_if<PlanarFrame>(&options.frame);
    placed_ = plane != nullptr ? placed_on_plane(mesh, *plane)
                               : placed_on_ellipsoid(mesh, std::get<GeodeticFrame>(options.frame));
    lattice_ = lattice_of(mesh);
  }

  std::string write() {
    Json primitives = Json::array(), materials = Json::array();
    for (const Part& part : parts_of(mesh_)) {
      Json primitive{{"attributes", attributes_of(part)},
                     {"indices", add_indices(part)},
                     {"material", materials.size()},
                     {"mode", 4}};
      if (part.zone >= 0) {
        const auto zone = static_cast<std::uint16_t>(part.zone);
        primitive["extras"] = {{"zone", part.zone}};
        if (is_transition(zone)) primitive["extras"]["zones"] = {first_zone(zone), second_zone(zone)};
        materials.push_back(material_of(zone_name(zone, options_), zone_colour(part.zone)));
      } else {
        materials.push_back(material_of("terrain", {0.62, 0.6, 0.56}));
      }
      primitives.push_back(primitive);
    }
    Json json{{"asset", {{"version", "2.0"}, {"generator", "Lodestone"}}}};
    if (options_.is_quantized)
      json["extensionsUsed"] = json["extensionsRequired"] = {"KHR_mesh_quantization"};
    json["scene"] = 0;
    json["scenes"] = Json::array({{{"nodes", {0}}}});
    json["nodes"] = Json::array({node()});
    json["meshes"] =
        Json::array({{{"name", options_.name}, {"primitives", primitives}, {"extras", extras()}}});
    json["materials"] = materials;
    json["accessors"] = binary_.accessors_;
    json["bufferViews"] = binary_.views_;
    json["buffers"] = Json::array({{{"byteLength", binary_.bytes_.size()}}});
    return assemble(json.dump());
  }

 private:
  template <class T>
  std::vector<T> picked(const Part& part, const std::vector<T>& values, std::size_t components) const {
    std::vector<T> result;
    result.reserve(part.vertices.size() * components);
    for (const std::uint32_t v : part.vertices) {
      result.insert(result.end(), values.begin() + static_cast<std::ptrdiff_t>(v * components),
                    values.begin() + static_cast<std::ptrdiff_t>((v + 1) * components));
    }
    return result;
  }

  Json attributes_of(const Part& part) {
    Json attributes;
    if (options_.is_quantized) {
      std::vector<std::uint16_t> positions;
      for (const std::uint32_t v : part.vertices) {
        const TinVertex& p = mesh_.vertices[v];
        positions.insert(
            positions.end(),
            {static_cast<std::uint16_t>(p.col),
             static_cast<std::uint16_t>(std::floor((p.height_m - lattice_.base_m) / lattice_.step_m + 0.5)),
             static_cast<std::uint16_t>(p.row)});
      }
      attributes["POSITION"] = binary_.add(positions, 3, kUnsignedShort, 8, false, true);
      if (!placed_.normals.empty()) {
        std::vector<std::int8_t> normals;
        for (const float n : picked(part, placed_.normals, 3))
          normals.push_back(static_cast<std::int8_t>(std::floor(n * 127 + 0.5F)));
        attributes["NORMAL"] = binary_.add(normals, 3, kByte, 4, true, false);
      }
    } else {
      attributes["POSITION"] = binary_.add(picked(part, placed_.positions, 3), 3, kFloat, 12, false, true);
      if (!placed_.normals.empty())
        attributes["NORMAL"] = binary_.add(picked(part, placed_.normals, 3), 3, kFloat, 12, false, false);
    }
    attributes["TEXCOORD_0"] = binary_.add(uvs_of(part), 2, kFloat, 8, false, false);
    if (!part.blend.empty()) attributes["_BLEND"] = binary_.add(part.blend, 1, kFloat, 4, false, false);
    return attributes;
  }

  std::vector<float> uvs_of(const Part& part) const {
    std::vector<float> uvs;
    const auto* plane = std::get_if<PlanarFrame>(&options_.frame);
    for (const std::uint32_t v : part.vertices) {
      const TinVertex& p = mesh_.vertices[v];
      if (plane != nullptr && options_.texture_size_m) {
        // Metres from the layer's origin, less the whole repeats at the tile's edge: neighbours differ by
        // whole repeats only.
        const double size = *options_.texture_size_m;
        const auto share = [size](double edge_m, double offset_m) {
          return (edge_m + offset_m - size * std::floor(edge_m / size)) / size;
        };
        uvs.push_back(static_cast<float>(share(plane->west_m, p.col * plane->spacing_x_m)));
        uvs.push_back(static_cast<float>(share(plane->north_m, p.row * plane->spacing_y_m)));
      } else {
        uvs.push_back(static_cast<float>(static_cast<double>(p.col) / (mesh_.cols - 1)));
        uvs.push_back(static_cast<float>(static_cast<double>(p.row) / (mesh_.rows - 1)));
      }
    }
    return uvs;
  }

  int add_indices(const Part& part) {
    if (part.vertices.size() > 65535)
      return binary_.add(part.indices, 1, kUnsignedInt, 0, false, false);  // 65535 itself restarts primitives
    return binary_.add(std::vector<std::uint16_t>(part.indices.begin(), part.indices.end()), 1,
                       kUnsignedShort, 0, false, false);
  }

  Json node() const {
    Json node{{"name", options_.name}, {"mesh", 0}};
    if (options_.is_quantized) {
      const auto& plane = std::get<PlanarFrame>(options_.frame);
      node["translation"] = {plane.west_m, lattice_.base_m, plane.north_m};
      node["scale"] = {plane.spacing_x_m, lattice_.step_m, plane.spacing_y_m};
    } else {
      node["translation"] = placed_.translation;
    }
    return node;
  }

  Json extras() const {
    Json extras{{"maxErrorM", mesh_.max_error_m + (options_.is_quantized ? lattice_.step_m / 2 : 0)},
                {"rmsErrorM", mesh_.rms_error_m},
                {"skirtDepthM", mesh_.skirt_depth_m},
                {"posts", {mesh_.cols, mesh_.rows}},
                {"origin", {mesh_.i0, mesh_.j0}}};
    if (mesh_.zones.empty()) {
      extras["topVertices"] = mesh_.top_vertices;
      extras["topTriangles"] = mesh_.top_triangles;
    }
    for (const auto& [key, value] : options_.extras) extras[key] = value;
    return extras;
  }

  std::string assemble(std::string json) const {
    std::string bin = binary_.bytes_;
    json.resize((json.size() + 3) / 4 * 4, ' ');
    bin.resize((bin.size() + 3) / 4 * 4, '\0');
    std::string out;
    const auto word = [&out](std::uint32_t w) {
      for (int i = 0; i < 4; ++i) out.push_back(static_cast<char>(w >> 8 * i & 0xff));
    };
    word(kMagic);
    word(kVersion);
    word(static_cast<std::uint32_t>(12 + 8 + json.size() + 8 + bin.size()));
    word(static_cast<std::uint32_t>(json.size()));
    word(kJsonChunk);
    out += json;
    word(static_cast<std::uint32_t>(bin.size()));
    word(kBinChunk);
    out += bin;
    return out;
  }

  const TinMesh& mesh_;
  const GlbOptions& options_;
  PlacedMesh placed_;
  Lattice lattice_;
  BinaryWriter binary_;
};

}  // namespace

Result<std::string> encode_glb(const TinMesh& mesh, const GlbOptions& options) {
  if (mesh.triangles.empty())
    return Error{ErrorCode::kInvalidArgument,
                 "GLB: the mesh has no triangles; a tile of nothing but voids has no GLB"};
  if (mesh.triangles.size() > (std::size_t{1} << 26))
    return Error{ErrorCode::kTooLarge,
                 "GLB: at most 2^26 indices, found " + std::to_string(mesh.triangles.size())};
  if (options.is_quantized && !std::holds_alternative<PlanarFrame>(options.frame)) {
    return Error{ErrorCode::kInvalidArgument, "GLB: quantised positions need a planar frame; ask for floats"};
  }
  if (options.texture_size_m && !(*options.texture_size_m > 0))
    return Error{ErrorCode::kInvalidArgument, "GLB: the texture size must be > 0 m"};
  return GlbWriter(mesh, options).write();
}

namespace {

struct View {
  std::span<const std::uint8_t> bytes;
  std::size_t stride, count;
  int component_type;
  std::size_t components;
  bool is_normalized;
};

std::size_t component_size(int type) { return type == kByte ? 1 : type == kUnsignedShort ? 2 : 4; }

// Throws nlohmann's exceptions for missing or mistyped members; the caller turns them into an Error.
Result<View> accessor_view(const Json& json, std::span<const std::uint8_t> bin, std::size_t number) {
  const Json& accessor = json.at("accessors").at(number);
  const Json& view = json.at("bufferViews").at(accessor.at("bufferView").get<std::size_t>());
  if (view.at("buffer").get<std::size_t>() != 0) return corrupt("a buffer view outside the file");
  const std::string type = accessor.at("type").get<std::string>();
  View result{};
  result.components = type == "SCALAR" ? 1 : type == "VEC2" ? 2 : type == "VEC3" ? 3 : 0;
  result.component_type = accessor.at("componentType").get<int>();
  const bool is_known = result.component_type == kByte || result.component_type == kUnsignedShort ||
                        result.component_type == kUnsignedInt || result.component_type == kFloat;
  if (result.components == 0 || !is_known)
    return Error{ErrorCode::kUnsupported,
                 "GLB: accessor " + std::to_string(number) + " has a type that we do not write"};
  result.is_normalized = accessor.value("normalized", false);
  result.count = accessor.at("count").get<std::size_t>();
  const std::size_t size = component_size(result.component_type) * result.components;
  result.stride = view.value("byteStride", size);
  const std::size_t view_at = view.value("byteOffset", std::size_t{0}),
                    view_length = view.at("byteLength").get<std::size_t>();
  const std::size_t at = accessor.value("byteOffset", std::size_t{0});
  if (view_at > bin.size() || view_length > bin.size() - view_at || at > view_length ||
      result.stride < size || result.count == 0 || size > view_length - at ||
      result.count - 1 > (view_length - at - size) / result.stride) {
    return corrupt("accessor " + std::to_string(number) + " reaches outside its buffer");
  }
  result.bytes = bin.subspan(view_at + at, view_length - at);
  return result;
}

double component(const View& view, std::size_t element, std::size_t k) {
  const std::uint8_t* p = view.bytes.data() + element * view.stride + k * component_size(view.component_type);
  switch (view.component_type) {
    case kByte: {
      const double v = static_cast<std::int8_t>(*p);
      return view.is_normalized ? std::max(v / 127, -1.0) : v;
    }
    case kUnsignedShort: {
      std::uint16_t v = 0;
      std::memcpy(&v, p, sizeof v);
      return view.is_normalized ? v / 65535.0 : v;
    }
    case kUnsignedInt: {
      std::uint32_t v = 0;
      std::memcpy(&v, p, sizeof v);
      return v;
    }
    default: {
      float v = 0;
      std::memcpy(&v, p, sizeof v);
      return v;
    }
  }
}

Result<DecodedGlb> decode_chunks(std::span<const std::uint8_t> json_bytes, std::span<const std::uint8_t> bin,
                                 std::size_t max_bytes) {
  DecodedGlb decoded;
  decoded.json.assign(json_bytes.begin(), json_bytes.end());
  const Json json = Json::parse(decoded.json);
  const Json& node = json.at("nodes").at(0);
  if (node.contains("translation")) decoded.translation = node["translation"].get<Vec3>();
  if (node.contains("scale")) decoded.scale = node["scale"].get<Vec3>();
  std::size_t charged = 0;
  for (const Json& primitive : json.at("meshes").at(0).at("primitives")) {
    GlbPrimitive out;
    const auto read = [&](const char* name, std::size_t components,
                          std::vector<float>& values) -> Result<void> {
      const Json& attributes = primitive.at("attributes");
      if (!attributes.contains(name)) return {};
      Result<View> view = accessor_view(json, bin, attributes[name].get<std::size_t>());
      if (!view) return std::move(view.error());
      if (view->components != components)
        return corrupt(std::string(name) + " has the wrong number of components");
      charged += view->count * components * sizeof(float);
      if (charged > max_bytes)
        return Error{ErrorCode::kTooLarge, "GLB: more than " + std::to_string(max_bytes) + " bytes decoded"};
      for (std::size_t i = 0; i < view->count; ++i) {
        for (std::size_t k = 0; k < components; ++k)
          values.push_back(static_cast<float>(component(*view, i, k)));
      }
      return {};
    };
    if (Result<void> r = read("POSITION", 3, out.positions); !r) return std::move(r.error());
    if (Result<void> r = read("NORMAL", 3, out.normals); !r) return std::move(r.error());
    if (Result<void> r = read("TEXCOORD_0", 2, out.uvs); !r) return std::move(r.error());
    if (Result<void> r = read("_BLEND", 1, out.blend); !r) return std::move(r.error());
    Result<View> indices = accessor_view(json, bin, primitive.at("indices").get<std::size_t>());
    if (!indices) return std::move(indices.error());
    if (indices->components != 1 ||
        (indices->component_type != kUnsignedShort && indices->component_type != kUnsignedInt))
      return corrupt("indices of a wrong type");
    charged += indices->count * sizeof(std::uint32_t);
    if (charged > max_bytes)
      return Error{ErrorCode::kTooLarge, "GLB: more than " + std::to_string(max_bytes) + " bytes decoded"};
    for (std::size_t i = 0; i < indices->count; ++i) {
      const auto index = static_cast<std::uint32_t>(component(*indices, i, 0));
      if (index >= out.positions.size() / 3)
        return corrupt("index " + std::to_string(index) + " of " + std::to_string(out.positions.size() / 3) +
                       " vertices");
      out.indices.push_back(index);
    }
    if (primitive.contains("extras")) out.zone = primitive["extras"].value("zone", -1);
    decoded.primitives.push_back(std::move(out));
  }
  return decoded;
}

}  // namespace

Result<DecodedGlb> decode_glb(std::span<const std::uint8_t> bytes, std::size_t max_bytes) {
  const auto word = [&](std::size_t at) {
    std::uint32_t w = 0;
    std::memcpy(&w, bytes.data() + at, sizeof w);
    return w;
  };
  if (bytes.size() < 20 || word(0) != kMagic) return corrupt("the file does not begin with a glTF header");
  if (word(4) != kVersion)
    return Error{ErrorCode::kUnsupported, "GLB: version 2 expected, found " + std::to_string(word(4))};
  if (word(8) != bytes.size())
    return corrupt(std::to_string(word(8)) + " bytes declared, " + std::to_string(bytes.size()) + " found");
  const std::size_t json_length = word(12);
  if (word(16) != kJsonChunk || json_length > bytes.size() - 20)
    return corrupt("the first chunk must be JSON inside the file");
  std::span<const std::uint8_t> bin;
  if (const std::size_t at = 20 + json_length; bytes.size() - at >= 8) {
    if (word(at + 4) != kBinChunk || word(at) > bytes.size() - at - 8)
      return corrupt("the second chunk must be BIN inside the file");
    bin = bytes.subspan(at + 8, word(at));
  }
  try {
    return decode_chunks(bytes.subspan(20, json_length), bin, max_bytes);
  } catch (const Json::exception& e) {
    return corrupt(e.what());
  }
}

}  // namespace lodestone
