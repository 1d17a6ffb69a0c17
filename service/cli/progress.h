#pragma once
// Progress of long work: a bar on a terminal, a plain line every ten per cent elsewhere.

#include <string>

namespace lodestone {

class ProgressBar {
 public:
  // is_quiet: prints nothing (--json).
  explicit ProgressBar(bool is_quiet);
  // fraction: 0..1, of the whole.
  void show(const std::string& phase, double fraction);
  void done();

 private:
  const bool is_quiet_, is_terminal_;
  int shown_ = -1;
  std::string phase_;
};

}  // namespace lodestone
