#include "service/config/recipe.h"

#include <fmt/format.h>

#include <charconv>
#include <cmath>

#include "kernels/fractal/node_roughness.h"

namespace lodestone {
namespace {

constexpr std::array<std::string_view, 6> kMethods = {"linear",         "gsa",           "lsa",
                                                      "square-square", "diamond-square", "fractal-wavelet"};

Error bad_value(const std::string& name, const std::string& text, const std::string& rule) {
  return Error{ErrorCode::kInvalidArgument, fmt::format("recipe parameter {} = {}: {}", name, text, rule)};
}

// The position of `text` in `allowed`, or an error that lists them.
Result<int> choice(const std::string& name, const std::string& text, const std::vector<std::string_view>& allowed) {
  for (std::size_t n = 0; n < allowed.size(); ++n) {
    if (allowed[n] == text) return static_cast<int>(n);
  }
  return bad_value(name, text, fmt::format("must be one of {}", fmt::join(allowed, ", ")));
}

Result<double> number(const std::string& name, const std::string& text, double min, double max) {
  double value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (code != std::errc() || end != text.data() + text.size() || !std::isfinite(value) || value < min || value > max) {
    return bad_value(name, text, fmt::format("must be a number in {}..{}", min, max));
  }
  return value;
}

Result<int> whole(const std::string& name, const std::string& text, int min, int max) {
  int value = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (code != std::errc() || end != text.data() + text.size() || value < min || value > max) {
    return bad_value(name, text, fmt::format("must be a whole number in {}..{}", min, max));
  }
  return value;
}

}  // namespace

std::string_view to_string(Method method) { return kMethods[static_cast<std::size_t>(method)]; }

std::map<std::string, Recipe> fixed_recipes() {
  std::map<std::string, Recipe> recipes;
  for (std::size_t n = 0; n < kMethods.size(); ++n) {
    Recipe recipe;
    recipe.method = static_cast<Method>(n);
    recipes.emplace(kMethods[n], recipe);
  }
  return recipes;
}

Result<std::uint64_t> parse_seed(std::string_view text) {
  std::uint64_t seed = 0;
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), seed);
  if (text.empty() || code != std::errc() || end != text.data() + text.size()) {
    return Error{ErrorCode::kInvalidArgument,
                 fmt::format("seed \"{}\": must be a whole number in 0..18446744073709551615", text)};
  }
  return seed;
}

std::vector<std::string> recipe_parameter_names() {
  return {"method", "seed",      "window", "levels", "trust", "energy", "fit",     "param",  "basis", "masks",
          "mask_mode", "quantum", "depth_limit", "node", "volume", "erosion", "water", "cap", "altitude"};
}

Result<void> set_recipe_parameter(Recipe& recipe, const std::string& name, const std::string& text,
                                  const std::vector<std::string>& list) {
  const auto pick = [&](auto& target, std::vector<std::string_view> allowed, auto from_index) -> Result<void> {
    auto index = choice(name, text, allowed);
    if (!index) return index.error();
    target = from_index(*index);
    return {};
  };
  const auto put_number = [&](auto& target, double min, double max) -> Result<void> {
    auto value = number(name, text, min, max);
    if (!value) return value.error();
    target = *value;
    return {};
  };
  const auto put_whole = [&](int& target, int min, int max) -> Result<void> {
    auto value = whole(name, text, min, max);
    if (!value) return value.error();
    target = *value;
    return {};
  };
  if (name == "method") {
    return pick(recipe.method, {kMethods.begin(), kMethods.end()}, [](int n) { return static_cast<Method>(n); });
  }
  if (name == "seed") {
    auto seed = parse_seed(text);
    if (!seed) return seed.error();
    recipe.seed = *seed;
    return {};
  }
  if (name == "window") {
    return pick(recipe.lsa.window, {"1", "3", "5", "7"}, [](int n) { return 2 * n + 1; });
  }
  if (name == "levels") return put_whole(recipe.lsa.levels, 1, 6);
  if (name == "trust") return put_number(recipe.lsa.trust, 0, 1);
  if (name == "energy") return pick(recipe.lsa.match_energy, {"free", "match"}, [](int n) { return n == 1; });
  if (name == "fit") {
    return pick(recipe.lsa.fit, {"weighted", "paper"}, [](int n) { return static_cast<FitWeights>(n); });
  }
  if (name == "param") {
    return pick(recipe.lookup, {"smooth", "nearest", "constant"},
                [](int n) { return n == 0 ? SigmaLookup::kSmooth : SigmaLookup::kNearest; });
  }
  if (name == "basis") {
    return pick(recipe.basis, {"cdf22", "cdf44"}, [](int n) { return static_cast<WaveletBasis>(n); });
  }
  if (name == "masks") {
    recipe.masks = list;
    return {};
  }
  if (name == "mask_mode") {
    return pick(recipe.mask_mode, {"absorb", "protect"}, [](int n) { return static_cast<MaskMode>(n); });
  }
  if (name == "quantum") {
    if (text != "off" && text != "auto") {
      auto value = number(name, text, 1.0 / 1024, 64);
      if (!value || std::exp2(std::round(std::log2(*value))) != *value) {
        return bad_value(name, text, "must be off, auto or a power of two in 0.0009765625..64 metres");
      }
    }
    recipe.quantum = text;
    return {};
  }
  if (name == "depth_limit") return put_whole(recipe.depth_limit, 0, kMaxDepth);
  if (name == "node") return put_whole(recipe.node, 2, kMaxNodeLog2);
  if (name == "volume") return pick(recipe.is_volume_published, {"triangle", "published"}, [](int n) { return n == 1; });
  if (name == "erosion") return pick(recipe.has_erosion, {"false", "true"}, [](int n) { return n == 1; });
  if (name == "water") return put_number(recipe.water_m, -12000, 9000);
  if (name == "cap") return put_number(recipe.cap_m, 0, 10000);
  if (name == "altitude") {
    if (list.size() != 4) return bad_value(name, text, "must be a list of four numbers: z0, z1, lo, hi");
    recipe.altitude.clear();
    for (const std::string& item : list) {
      auto value = number(name, item, -12000, 12000);
      if (!value) return value.error();
      recipe.altitude.push_back(*value);
    }
    if (recipe.altitude[0] >= recipe.altitude[1]) return bad_value(name, text, "z0 must be below z1");
    return {};
  }
  return Error{ErrorCode::kInvalidArgument, fmt::format("unknown recipe parameter {}", name)};
}

std::string recipe_text(const Recipe& r) {
  std::string text = fmt::format("method = \"{}\"\nseed = {}\n", to_string(r.method), r.seed);
  std::vector<std::string> quoted;
  for (const std::string& mask : r.masks) quoted.push_back('"' + mask + '"');
  if (r.method == Method::kGsa || r.method == Method::kLsa) {
    text += fmt::format("fit = \"{}\"\n", r.lsa.fit == FitWeights::kPaper ? "paper" : "weighted");
  }
  if (r.method == Method::kLsa) {
    text += fmt::format("window = {}\nlevels = {}\ntrust = {}\nenergy = \"{}\"\n", r.lsa.window, r.lsa.levels,
                        r.lsa.trust, r.lsa.match_energy ? "match" : "free");
  }
  if (r.method != Method::kLinear && r.method != Method::kGsa) {
    const bool is_midpoint = r.method != Method::kLsa;
    text += fmt::format("param = \"{}\"\n",
                        r.lookup == SigmaLookup::kSmooth ? "smooth" : (is_midpoint ? "constant" : "nearest"));
  }
  if (r.method <= Method::kLsa) text += fmt::format("basis = \"{}\"\n", r.basis == WaveletBasis::kCdf44 ? "cdf44" : "cdf22");
  if (r.method != Method::kLinear) {
    text += fmt::format("masks = [{}]\nmask_mode = \"{}\"\n", fmt::join(quoted, ", "),
                        r.mask_mode == MaskMode::kProtect ? "protect" : "absorb");
  }
  const bool is_number = r.quantum != "off" && r.quantum != "auto";
  text += fmt::format("quantum = {0}{1}{0}\ndepth_limit = {2}\n", is_number ? "" : "\"", r.quantum, r.depth_limit);
  if (r.method >= Method::kSquareSquare) text += fmt::format("node = {}\n", r.node);
  if (r.method == Method::kFractalWavelet) {
    text += fmt::format("volume = \"{}\"\nerosion = {}\n", r.is_volume_published ? "published" : "triangle", r.has_erosion);
    if (r.water_m) text += fmt::format("water = {}\n", *r.water_m);
    if (r.cap_m) text += fmt::format("cap = {}\n", *r.cap_m);
    if (!r.altitude.empty()) text += fmt::format("altitude = [{}]\n", fmt::join(r.altitude, ", "));
  }
  return text;
}

}  // namespace lodestone
