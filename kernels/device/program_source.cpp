#include "kernels/device/program_source.h"

#include <algorithm>
#include <cassert>
#include <set>

#include "cmake/embed.h"
#include "kernels/device/device.h"

namespace lodestone {

extern const EmbeddedFile kernel_texts[];
extern const std::size_t kernel_texts_count;

namespace {

std::string_view text_of(std::string_view name) {
  for (std::size_t n = 0; n < kernel_texts_count; ++n)
    if (kernel_texts[n].name == name) return kernel_texts[n].text;
  assert(false && "a kernel includes a file that is not in kernels/shared");
  return {};
}

void paste(std::string_view text, std::set<std::string_view>& seen, std::string& out) {
  constexpr std::string_view kInclude = "#include \"";
  while (!text.empty()) {
    const std::size_t end = std::min(text.find('\n'), text.size() - 1) + 1;
    const std::string_view line = text.substr(0, end);
    text.remove_prefix(end);
    if (!line.starts_with(kInclude)) {
      out += line;
      continue;
    }
    const std::string_view name = line.substr(kInclude.size(), line.find('"', kInclude.size()) - kInclude.size());
    if (seen.insert(name).second) paste(text_of(name), seen, out);
  }
}

}  // namespace

std::uint64_t fnv1a(std::string_view text, std::uint64_t hash) {
  for (const char c : text) hash = (hash ^ static_cast<unsigned char>(c)) * 0x100000001b3ull;
  return hash;
}

std::vector<ProgramSource> program_sources() {
  std::vector<ProgramSource> sources;
  for (std::size_t n = 0; n < kernel_texts_count; ++n) {
    const std::string_view path = kernel_texts[n].name;
    if (!path.ends_with(".cl")) continue;
    const std::size_t slash = path.rfind('/');
    ProgramSource source{std::string(path.substr(slash + 1, path.size() - slash - 4)), {}};
    std::set<std::string_view> seen;
    paste(kernel_texts[n].text, seen, source.text);
    sources.push_back(std::move(source));
  }
  std::sort(sources.begin(), sources.end(), [](const auto& a, const auto& b) { return a.name < b.name; });
  return sources;
}

std::uint64_t kernel_source_hash() {
  static const std::uint64_t hash = [] {
    std::uint64_t h = 0xcbf29ce484222325ull;
    for (const ProgramSource& source : program_sources()) h = fnv1a(source.text, fnv1a(source.name, h));
    return h;
  }();
  return hash;
}

}  // namespace lodestone
