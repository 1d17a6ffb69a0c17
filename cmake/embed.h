#pragma once
// EmbeddedFile: a text file of the source tree, compiled into the program by lodestone_embed().

#include <cstddef>
#include <string_view>

namespace lodestone {
struct EmbeddedFile {
  std::string_view name;  // path below the project's root
  std::string_view text;
};
}  // namespace lodestone
