#include "service/cli/commands.h"

namespace lodestone {

const std::vector<CommandSpec>& command_specs() {
  static const std::vector<CommandSpec> specs = {
      {"ingest", "Read elevation rasters into a layer", false, declare_ingest},
      {"serve", "Run the daemon", true, declare_serve},
      {"tile", "Write one tile to a file", false, declare_tile},
      {"inspect", "Describe the layers of a data directory", false, declare_inspect},
      {"verify", "Check every stored value", false, declare_verify},
      {"purge", "Drop cached tiles", false, declare_purge},
      {"devices", "List the OpenCL devices", false, declare_devices},
      {"config", "Check or print the configuration", true, declare_config},
      {"evaluate", "Measure how well synthetic levels continue the real ones", false, declare_evaluate},
  };
  return specs;
}

}  // namespace lodestone
