#pragma once
// Kernel texts embedded in the library: shared headers pasted in, hashes.

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace lodestone {

std::uint64_t fnv1a(std::string_view text, std::uint64_t hash = 0xcbf29ce484222325ull);

struct ProgramSource {
  std::string name;  // stem of the .cl file
  std::string text;  // #include "kernels/..." lines replaced by the files, each once
};

// One per .cl file, sorted by name.
std::vector<ProgramSource> program_sources();

}  // namespace lodestone
