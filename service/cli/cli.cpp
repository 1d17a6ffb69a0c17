#include "service/cli/cli.h"

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <cstdio>

#include "service/cli/commands.h"
#include "service/http/problem.h"

namespace lodestone {
namespace {

// The flags that every option has: --some-name VALUE for some_name, collected as (name, text).
void add_option_flags(CLI::App& command, CommonFlags& flags, bool all) {
  command.add_option("--config", flags.config, "Configuration file (TOML)")->envname("LODESTONE_CONFIG");
  for (const OptionDescription& option : option_descriptions()) {
    const bool is_common = option.name == "data_dir" || option.name == "device" || option.name == "platform" || option.name == "workers" ||
                           option.name == "log_level";
    if (!all && !is_common) continue;
    std::string flag = "--" + option.name;
    std::replace(flag.begin(), flag.end(), '_', '-');
    const std::string range = option.is_text ? "" : fmt::format(" [{} {}]", option.unit, option.range);
    command
        .add_option_function<std::string>(
            flag, [&flags, name = option.name](const std::string& text) { flags.values.emplace_back(name, text); }, option.meaning + range)
        ->default_str(option.default_text);
  }
}

}  // namespace

Result<Options> CommonFlags::load() const { return load_options(config.empty() ? std::nullopt : std::optional(config), values); }

int fail(const Error& error) {
  // Bytes of a damaged file may be in the message: what is not UTF-8 or a control character is shown as \xNN.
  fmt::print(stderr, "lodestone: {}\n", http::safe_echo(error.message, 8000));
  return error.code == ErrorCode::kInvalidArgument ? kWrongUsage : kFailed;
}

int run_cli(int argc, char** argv) {
  CLI::App app("Lodestone: a terrain tile cache that turns limited real elevation data into unlimited consistent ground.", "lodestone");
  app.set_version_flag("--version", "lodestone 0.1.0");
  app.require_subcommand(1);
  app.fallthrough(false);
  CommonFlags flags;
  int exit_code = kDone;
  for (const CommandSpec& spec : command_specs()) {
    CLI::App* command = app.add_subcommand(spec.name, spec.meaning);
    add_option_flags(*command, flags, spec.takes_all_options);
    const auto run = spec.declare(*command, flags);
    command->final_callback([run, &exit_code] { exit_code = run(); });
  }
  try {
    app.parse(argc, argv);
  } catch (const CLI::Success& success) {
    app.exit(success);
    return kDone;
  } catch (const CLI::ParseError& error) {
    fmt::print(stderr, "lodestone: {}\nRun `lodestone --help` or `lodestone COMMAND --help`.\n", error.what());
    return kWrongUsage;
  }
  return exit_code;
}

}  // namespace lodestone
