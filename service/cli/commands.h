#pragma once
// The commands: each declares its flags on a CLI11 command and gives the function that runs it.

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "kernels/types/result.h"
#include "service/config/options.h"

namespace CLI {
class App;
}

namespace lodestone {

inline constexpr int kDone = 0;
inline constexpr int kFailed = 1;
inline constexpr int kWrongUsage = 2;
inline constexpr int kDoneWithFailures = 3;

// What the command line said about configuration.
struct CommonFlags {
  std::string config;
  std::vector<std::pair<std::string, std::string>> values;
  Result<Options> load() const;
};

using Run = std::function<int()>;

struct CommandSpec {
  std::string name, meaning;
  bool takes_all_options;  // else only data_dir, device, platform, workers, log_level
  Run (*declare)(CLI::App&, CommonFlags&);
};
const std::vector<CommandSpec>& command_specs();

Run declare_ingest(CLI::App& command, CommonFlags& flags);
Run declare_serve(CLI::App& command, CommonFlags& flags);
Run declare_tile(CLI::App& command, CommonFlags& flags);
Run declare_inspect(CLI::App& command, CommonFlags& flags);
Run declare_verify(CLI::App& command, CommonFlags& flags);
Run declare_purge(CLI::App& command, CommonFlags& flags);
Run declare_devices(CLI::App& command, CommonFlags& flags);
Run declare_config(CLI::App& command, CommonFlags& flags);
Run declare_evaluate(CLI::App& command, CommonFlags& flags);

// Prints "lodestone: <message>" and gives the exit code.
int fail(const Error& error);

}  // namespace lodestone
