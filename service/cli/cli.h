#pragma once
// The command line: lodestone <command> ...

namespace lodestone {

// Runs the command; gives the exit code: 0 done, 1 failed, 2 wrong usage, 3 done with failures listed.
int run_cli(int argc, char** argv);

}  // namespace lodestone
