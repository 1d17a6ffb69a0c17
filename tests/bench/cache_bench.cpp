// The two caches: a hit in memory (the daemon's hot path), a hit on disk against the bare LMDB read it replaces, and writing with eviction.
#include <benchmark/benchmark.h>
#include <lmdb.h>

#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <random>
#include <string>

#include "storage/cache/disk_cache.h"
#include "storage/cache/memory_cache.h"

namespace lodestone {
namespace {

CacheKey key_of(std::uint64_t number) { return {number * 0x9E3779B97F4A7C15u ^ number >> 7, number * 0xD6E8FEB86659FD93u + 1}; }
CachedTilePtr tile_of(std::size_t bytes, std::uint64_t seed = 1) {
  auto tile = std::make_shared<CachedTile>();
  tile->body.resize(bytes);
  std::mt19937_64 random(seed);
  for (char& byte : tile->body) byte = static_cast<char>(random());
  return tile;
}

class Scratch {
 public:
  Scratch() {
    std::string name = (std::filesystem::temp_directory_path() / "lodestone-bench-XXXXXX").string();
    if (!::mkdtemp(name.data())) std::abort();
    path_ = name;
  }
  ~Scratch() { std::filesystem::remove_all(path_); }
  const std::filesystem::path& path() const { return path_; }

 private:
  std::filesystem::path path_;
};

void BM_MemoryHit(benchmark::State& state) {
  static const std::unique_ptr<MemoryCache> cache = [] {
    auto made = MemoryCache::create(std::size_t{512} << 20);
    const CachedTilePtr tile = tile_of(16384);
    for (std::uint64_t i = 0; i < 20000; ++i) made->put(key_of(i), tile);
    return made;
  }();
  std::uint64_t number = state.thread_index() * 7919;
  for (auto unused : state) {
    benchmark::DoNotOptimize(cache->get(key_of(number)));
    number = (number + 12289) % 20000;
  }
  state.SetItemsProcessed(state.iterations());
}
BENCHMARK(BM_MemoryHit)->Threads(1)->Threads(2)->UseRealTime();

void BM_MemoryPutWithEviction(benchmark::State& state) {
  const auto cache = MemoryCache::create(std::size_t{64} << 20);
  const CachedTilePtr tile = tile_of(16384);
  std::uint64_t number = 0;
  for (auto unused : state) cache->put(key_of(++number), tile);
  state.SetItemsProcessed(state.iterations());
}
BENCHMARK(BM_MemoryPutWithEviction);

void BM_DiskHit(benchmark::State& state) {
  const Scratch scratch;
  const auto bytes = static_cast<std::size_t>(state.range(0));
  DiskCacheOptions options;
  options.directory = scratch.path();
  options.budget_bytes = std::uint64_t{512} << 20;
  const auto cache = DiskCache::open(options);
  for (std::uint64_t i = 0; i < 1000; ++i) {
    cache->put(key_of(i), "bench", tile_of(bytes, i));
    if (i % 100 == 99) cache->flush();
  }
  std::uint64_t number = 0, hits = 0;
  for (auto unused : state) {
    hits += cache->get(key_of(number)) != nullptr;
    number = (number + 389) % 1000;
  }
  if (hits != static_cast<std::uint64_t>(state.iterations())) state.SkipWithError("a miss");
  state.SetBytesProcessed(state.iterations() * bytes);
}
BENCHMARK(BM_DiskHit)->ArgName("bytes")->Arg(4000)->Arg(65536)->Arg(262144);

// The lower bound: LMDB's own get and a copy, no checks.
void BM_BareLmdbHit(benchmark::State& state) {
  const Scratch scratch;
  const auto bytes = static_cast<std::size_t>(state.range(0));
  MDB_env* env = nullptr;
  MDB_txn* txn = nullptr;
  MDB_dbi dbi = 0;
  mdb_env_create(&env);
  mdb_env_set_mapsize(env, std::size_t{512} << 20);
  mdb_env_open(env, scratch.path().c_str(), MDB_NOSYNC | MDB_NOTLS, 0644);
  mdb_txn_begin(env, nullptr, 0, &txn);
  mdb_dbi_open(txn, nullptr, 0, &dbi);
  for (std::uint64_t i = 0; i < 1000; ++i) {
    const CachedTilePtr tile = tile_of(bytes, i);
    CacheKey name = key_of(i);
    MDB_val key{sizeof name, &name}, value{bytes, const_cast<char*>(tile->body.data())};
    mdb_put(txn, dbi, &key, &value, 0);
  }
  mdb_txn_commit(txn);
  std::uint64_t number = 0;
  for (auto unused : state) {
    CacheKey name = key_of(number);
    MDB_val key{sizeof name, &name}, value{};
    mdb_txn_begin(env, nullptr, MDB_RDONLY, &txn);
    if (mdb_get(txn, dbi, &key, &value) != 0) state.SkipWithError("a miss");
    std::string copy(static_cast<const char*>(value.mv_data), value.mv_size);
    benchmark::DoNotOptimize(copy);
    mdb_txn_abort(txn);
    number = (number + 389) % 1000;
  }
  mdb_env_close(env);
  state.SetBytesProcessed(state.iterations() * bytes);
}
BENCHMARK(BM_BareLmdbHit)->ArgName("bytes")->Arg(4000)->Arg(65536)->Arg(262144);

// Batches of 32, flushed, into a full cache: every batch evicts as much as it writes.
void BM_DiskPutWithEviction(benchmark::State& state) {
  const Scratch scratch;
  const auto bytes = static_cast<std::size_t>(state.range(0));
  DiskCacheOptions options;
  options.directory = scratch.path();
  options.budget_bytes = std::uint64_t{128} << 20;
  const auto cache = DiskCache::open(options);
  std::uint64_t number = 0;
  const auto put_batch = [&] {
    const CachedTilePtr tile = tile_of(bytes);
    for (int i = 0; i < 32; ++i) cache->put(key_of(++number), "bench", tile);
    cache->flush();
  };
  while (cache->stats().evictions == 0) put_batch();
  for (auto unused : state) put_batch();
  const DiskCache::Stats stats = cache->stats();
  if (stats.dropped_writes > 0) state.SkipWithError("dropped writes");
  state.SetItemsProcessed(state.iterations() * 32);
  state.counters["file_to_budget"] = static_cast<double>(std::filesystem::file_size(scratch.path() / "data.mdb")) / options.budget_bytes;
}
BENCHMARK(BM_DiskPutWithEviction)->ArgName("bytes")->Arg(4000)->Arg(65536)->UseRealTime();

}  // namespace
}  // namespace lodestone

BENCHMARK_MAIN();
