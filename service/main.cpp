// Entry point: parses, wires and runs; everything else is in service/cli.

#include <malloc.h>

#include "service/cli/cli.h"

int main(int argc, char** argv) {
  // Tiles are some 260 KB. By default glibc maps and unmaps every such buffer, and the kernel zeroes its pages each time:
  // a third of the cost of a cold tile. From the heap they are used again.
  mallopt(M_MMAP_THRESHOLD, 32 << 20);
  mallopt(M_TRIM_THRESHOLD, 128 << 20);
  mallopt(M_TOP_PAD, 4 << 20);
  return lodestone::run_cli(argc, argv);
}
