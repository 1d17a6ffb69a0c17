#pragma once
// Recipe: a named way to make the synthetic levels. Parameters are those of SPEC-SYNTHESIS section 8, by those names.

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/synthesis/roughness.h"
#include "kernels/synthesis/wavelet_task.h"
#include "kernels/types/result.h"

namespace lodestone {

enum class Method : std::uint8_t { kLinear, kGsa, kLsa, kSquareSquare, kDiamondSquare, kFractalWavelet };
std::string_view to_string(Method method);

struct Recipe {
  Method method = Method::kLsa;
  std::uint64_t seed = 0;
  LsaParameters lsa;                           // window, levels, trust, energy, fit
  SigmaLookup lookup = SigmaLookup::kSmooth;   // param = smooth | nearest (midpoint: smooth | constant)
  WaveletBasis basis = WaveletBasis::kCdf22;   // basis = cdf22 | cdf44
  std::vector<std::string> masks = {"*"};      // "*": every mask of the layer
  MaskMode mask_mode = MaskMode::kAbsorb;
  std::string quantum = "off";                 // off | auto | metres
  int depth_limit = kMaxDepth;                 // deepest synthetic level below base
  // Fractal methods.
  int node = 4;                                // nodes of 2^node data cells
  bool is_volume_published = false;            // volume = triangle | published
  bool has_erosion = false;
  std::optional<double> water_m, cap_m;
  std::vector<double> altitude;                // empty, or z0, z1, lo, hi
};

// linear, gsa, lsa, square-square, diamond-square, fractal-wavelet with the spec's defaults.
std::map<std::string, Recipe> fixed_recipes();

// One parameter from its TOML text (value written as in the file). Errors: kInvalidArgument, with the allowed values.
Result<void> set_recipe_parameter(Recipe& recipe, const std::string& name, const std::string& text,
                                  const std::vector<std::string>& list);
std::vector<std::string> recipe_parameter_names();
// All parameters as `name = value` TOML lines in a fixed order: the recipe's identity in cache keys and in `config dump`.
std::string recipe_text(const Recipe& recipe);

// Any uint64 in decimal. Error: kInvalidArgument.
Result<std::uint64_t> parse_seed(std::string_view text);

}  // namespace lodestone
