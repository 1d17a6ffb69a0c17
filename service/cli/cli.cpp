#include "service/cli/cli.h"

#include <cstdio>

namespace lodestone {

int run_cli(int, char**) {
  std::puts("lodestone");
  return 2;
}

}  // namespace lodestone
