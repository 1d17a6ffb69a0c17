#pragma once
// Options of the daemon and of the commands: defaults < lodestone.toml < environment (LODESTONE_...) < flags.

#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "kernels/types/result.h"
#include "service/config/recipe.h"

namespace lodestone {

struct Options {
#define LS_OPTION(type, name, value, unit, min, max, meaning) type name = value;
#define LS_TEXT(name, value, meaning) std::string name = value;
#include "config/options.def"
#undef LS_OPTION
#undef LS_TEXT
  std::map<std::string, Recipe> recipes = fixed_recipes();
  std::string admin_token;  // LODESTONE_ADMIN_TOKEN only; never in a file, never dumped
};

struct OptionDescription {
  std::string name, default_text, unit, range, meaning;
  bool is_text = false;
};
const std::vector<OptionDescription>& option_descriptions();

// Sets one option from its text. Errors: kInvalidArgument (unknown name with the nearest known one, type, range).
Result<void> set_option(Options& options, const std::string& name, const std::string& text);
// Text of one option as TOML writes it.
std::string option_text(const Options& options, const std::string& name);

// Reads the file (if given), the environment and then `flags` (name, text). Errors name file, line and column.
Result<Options> load_options(const std::optional<std::string>& config_file,
                             const std::vector<std::pair<std::string, std::string>>& flags);

// The whole configuration as TOML; secrets are masked. With comments: the text of config/lodestone.toml for the defaults.
std::string dump_options(const Options& options, bool with_comments);

// The known name nearest to `name` (edit distance at most 3), or empty.
std::string nearest_name(const std::string& name, const std::vector<std::string>& known);

}  // namespace lodestone
