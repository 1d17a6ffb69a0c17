#include "service/cli/progress.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>

namespace lodestone {

ProgressBar::ProgressBar(bool is_quiet) : is_quiet_(is_quiet), is_terminal_(::isatty(STDERR_FILENO) != 0) {}

void ProgressBar::show(const std::string& phase, double fraction) {
  if (is_quiet_) return;
  const int percent = std::clamp(static_cast<int>(fraction * 100), 0, 100);
  if (is_terminal_) {
    if (percent == shown_ && phase == phase_) return;
    const int filled = percent * 40 / 100;
    fmt::print(stderr, "\r[{}{}] {:3d} % {:<10}", std::string(static_cast<std::size_t>(filled), '#'),
               std::string(static_cast<std::size_t>(40 - filled), '.'), percent, phase);
    std::fflush(stderr);
  } else if (shown_ < 0 || percent / 10 != shown_ / 10) {
    fmt::print(stderr, "{:3d} % {}\n", percent, phase);
  } else {
    return;
  }
  shown_ = percent;
  phase_ = phase;
}

void ProgressBar::done() {
  if (!is_quiet_ && is_terminal_ && shown_ >= 0) fmt::print(stderr, "\n");
}

}  // namespace lodestone
