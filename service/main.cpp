// Entry point: parses, wires and runs; everything else is in service/cli.

#include "service/cli/cli.h"

int main(int argc, char** argv) { return lodestone::run_cli(argc, argv); }
