#include "service/config/options.h"

#include <fmt/format.h>

#include <toml++/toml.h>

#include <algorithm>
#include <charconv>
#include <cstdlib>
#include <numeric>
#include <sstream>

#include "storage/dem/layer_info.h"

extern char** environ;

namespace lodestone {
namespace {

Error bad(const std::string& message) { return Error{ErrorCode::kInvalidArgument, message}; }

template <class T>
Result<T> parse_number(const std::string& name, const std::string& text, T min, T max, const char* unit) {
  T value{};
  const auto [end, code] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || code != std::errc() || end != text.data() + text.size() || value < min || value > max) {
    return bad(fmt::format("option {} = {}: must be a number of {} in {}..{}", name, text, unit, min, max));
  }
  return value;
}

std::string quoted(const std::string& text) {
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"' || c == '\\') out += '\\';
    if (static_cast<unsigned char>(c) < 0x20) {
      out += fmt::format("\\u{:04x}", c);
    } else {
      out += c;
    }
  }
  return out + '"';
}

// The option or parameter's value as the text that set_option() takes.
std::string plain_text(const toml::node& node) {
  if (const auto* text = node.as_string()) return text->get();
  if (const auto* whole = node.as_integer()) return std::to_string(whole->get());
  if (const auto* real = node.as_floating_point()) return fmt::format("{}", real->get());
  if (const auto* flag = node.as_boolean()) return flag->get() ? "true" : "false";
  std::ostringstream out;
  out << toml::node_view<const toml::node>(node);
  return out.str();
}

std::string place(const std::string& file, const toml::source_region& region) {
  return fmt::format("{}:{}:{}", file, region.begin.line, region.begin.column);
}

Result<void> read_recipe(Options& options, const std::string& file, const std::string& name, const toml::node& node) {
  if (auto ok = check_name("recipe", name); !ok) return bad(place(file, node.source()) + ": " + ok.error().message);
  const auto* table = node.as_table();
  if (!table) return bad(fmt::format("{}: recipes.{} must be a table", place(file, node.source()), name));
  Recipe recipe = options.recipes.count(name) ? options.recipes[name] : Recipe{};
  for (const auto& [key, value] : *table) {
    const std::string parameter(key.str());
    const auto known = recipe_parameter_names();
    if (std::find(known.begin(), known.end(), parameter) == known.end()) {
      const std::string near = nearest_name(parameter, known);
      return bad(fmt::format("{}: unknown recipe parameter {} in recipes.{}{}", place(file, value.source()), parameter, name,
                             near.empty() ? "" : "; did you mean " + near + "?"));
    }
    std::vector<std::string> list;
    if (const auto* array = value.as_array()) {
      for (const auto& item : *array) list.push_back(plain_text(item));
    } else if (parameter == "masks" || parameter == "altitude") {
      return bad(fmt::format("{}: recipes.{}.{} must be a list", place(file, value.source()), name, parameter));
    }
    if (auto ok = set_recipe_parameter(recipe, parameter, plain_text(value), list); !ok) {
      return bad(fmt::format("{}: recipes.{}: {}", place(file, value.source()), name, ok.error().message));
    }
  }
  options.recipes[name] = recipe;
  return {};
}

Result<void> read_file(Options& options, const std::string& file) {
  toml::table parsed;
  try {
    parsed = toml::parse_file(file);
  } catch (const toml::parse_error& error) {
    return bad(fmt::format("{}: {}", place(file, error.source()), error.description()));
  }
  for (const auto& [key, value] : parsed) {
    const std::string name(key.str());
    if (name == "recipes") {
      const auto* recipes = value.as_table();
      if (!recipes) return bad(place(file, value.source()) + ": recipes must be a table of recipes");
      for (const auto& [recipe_name, recipe] : *recipes) {
        if (auto ok = read_recipe(options, file, std::string(recipe_name.str()), recipe); !ok) return ok;
      }
      continue;
    }
    if (value.is_table() || value.is_array()) {
      return bad(fmt::format("{}: {} must be a single value", place(file, value.source()), name));
    }
    if (auto ok = set_option(options, name, plain_text(value)); !ok) {
      return bad(place(file, value.source()) + ": " + ok.error().message);
    }
  }
  return {};
}

Result<void> read_environment(Options& options) {
  const std::string prefix = "LODESTONE_";
  for (char** entry = environ; *entry != nullptr; ++entry) {
    const std::string text = *entry;
    const auto equals = text.find('=');
    if (text.rfind(prefix, 0) != 0 || equals == std::string::npos) continue;
    std::string name = text.substr(prefix.size(), equals - prefix.size());
    const std::string value = text.substr(equals + 1);
    // Used by the build and the tests, not options: the program under test, the data beside it, the configuration's path.
    if (name == "BIN" || name == "SHARED_DATA" || name == "CONFIG" || name == "SOURCE_DIR") continue;
    if (name == "ADMIN_TOKEN") {
      options.admin_token = value;
      continue;
    }
    std::transform(name.begin(), name.end(), name.begin(), [](unsigned char c) { return static_cast<char>(std::tolower(c)); });
    if (auto ok = set_option(options, name, value); !ok) {
      return bad("environment " + text.substr(0, equals) + ": " + ok.error().message);
    }
  }
  return {};
}

}  // namespace

const std::vector<OptionDescription>& option_descriptions() {
  static const std::vector<OptionDescription> all = {
#define LS_OPTION(type, name, value, unit, min, max, meaning) \
  {#name, fmt::format("{}", static_cast<type>(value)), unit, fmt::format("{}..{}", min, max), meaning, false},
#define LS_TEXT(name, value, meaning) {#name, quoted(value), "", "", meaning, true},
#include "config/options.def"
#undef LS_OPTION
#undef LS_TEXT
  };
  return all;
}

Result<void> set_option(Options& options, const std::string& name, const std::string& text) {
#define LS_OPTION(type, field, value, unit, min, max, meaning)        \
  if (name == #field) {                                               \
    auto parsed = parse_number<type>(name, text, min, max, unit);     \
    if (!parsed) return parsed.error();                               \
    options.field = *parsed;                                          \
    return {};                                                        \
  }
#define LS_TEXT(field, value, meaning) \
  if (name == #field) {                \
    options.field = text;              \
    return {};                         \
  }
#include "config/options.def"
#undef LS_OPTION
#undef LS_TEXT
  std::vector<std::string> known;
  for (const auto& option : option_descriptions()) known.push_back(option.name);
  const std::string near = nearest_name(name, known);
  return bad(fmt::format("unknown option {}{}; `lodestone config dump` lists all", name,
                         near.empty() ? "" : "; did you mean " + near + "?"));
}

std::string option_text(const Options& options, const std::string& name) {
#define LS_OPTION(type, field, value, unit, min, max, meaning) \
  if (name == #field) return fmt::format("{}", options.field);
#define LS_TEXT(field, value, meaning) \
  if (name == #field) return quoted(options.field);
#include "config/options.def"
#undef LS_OPTION
#undef LS_TEXT
  return {};
}

Result<Options> load_options(const std::optional<std::string>& config_file,
                             const std::vector<std::pair<std::string, std::string>>& flags) {
  Options options;
  if (config_file) {
    if (auto ok = read_file(options, *config_file); !ok) return ok.error();
  }
  if (auto ok = read_environment(options); !ok) return ok.error();
  for (const auto& [name, text] : flags) {
    if (auto ok = set_option(options, name, text); !ok) return ok.error();
  }
  static const std::vector<std::string> levels = {"trace", "debug", "info", "warn", "error", "off"};
  if (std::find(levels.begin(), levels.end(), options.log_level) == levels.end()) {
    return bad("option log_level = " + options.log_level + ": must be trace, debug, info, warn, error or off");
  }
  return options;
}

std::string dump_options(const Options& options, bool with_comments) {
  std::string out;
  if (with_comments) {
    out += "# Lodestone configuration: every option with its default. Written by `lodestone config dump --comments`.\n"
           "# Order of precedence: these defaults < this file < environment (LODESTONE_NAME) < command-line flags.\n"
           "# The admin token is taken from the environment only: LODESTONE_ADMIN_TOKEN.\n\n";
  }
  for (const auto& option : option_descriptions()) {
    if (with_comments) {
      out += "# " + option.meaning + (option.is_text ? "" : " (" + option.unit + ", " + option.range + ")") + "\n";
    }
    out += option.name + " = " + option_text(options, option.name) + "\n";
  }
  if (with_comments) {
    out += "\n# Recipes: named ways to make the synthetic levels. The six below always exist; a [recipes.NAME] table changes one\n"
           "# or adds another. masks: names of the layer's masks, \"*\" = all of them.\n";
  } else if (!options.admin_token.empty()) {
    out += "# admin token: set (masked)\n";
  }
  for (const auto& [name, recipe] : options.recipes) out += "\n[recipes." + name + "]\n" + recipe_text(recipe);
  return out;
}

std::string nearest_name(const std::string& name, const std::vector<std::string>& known) {
  std::string best;
  std::size_t best_distance = 4;
  for (const std::string& candidate : known) {
    std::vector<std::size_t> row(candidate.size() + 1);
    std::iota(row.begin(), row.end(), std::size_t{0});
    for (std::size_t i = 0; i < name.size(); ++i) {
      std::size_t diagonal = std::exchange(row[0], i + 1);
      for (std::size_t j = 0; j < candidate.size(); ++j) {
        const std::size_t replace = diagonal + (name[i] == candidate[j] ? 0 : 1);
        diagonal = std::exchange(row[j + 1], std::min({replace, row[j] + 1, row[j + 1] + 1}));
      }
    }
    if (row.back() < best_distance) {
      best_distance = row.back();
      best = candidate;
    }
  }
  return best;
}

}  // namespace lodestone
