#include "storage/cache/memory_cache.h"

#include <gtest/gtest.h>

#include <atomic>
#include <random>
#include <thread>
#include <unordered_map>

namespace lodestone {
namespace {

CachedTilePtr tile_of(std::uint64_t number, std::size_t bytes) {
  auto tile = std::make_shared<CachedTile>();
  tile->body.assign(bytes, static_cast<char>('a' + number % 26));
  tile->body += std::to_string(number);
  return tile;
}
CacheKey key_of(std::uint64_t number) { return {number * 0x9E3779B97F4A7C15u ^ number >> 7, number * 0xD6E8FEB86659FD93u + 1}; }

TEST(MemoryCache, GivesBackWhatWasPut) {
  const auto cache = MemoryCache::create(1 << 20);
  EXPECT_EQ(cache->get(key_of(1)), nullptr);
  const CachedTilePtr tile = tile_of(1, 1000);
  cache->put(key_of(1), tile);
  EXPECT_EQ(cache->get(key_of(1)), tile);
  const CachedTilePtr other = tile_of(2, 3000);
  cache->put(key_of(1), other);
  EXPECT_EQ(cache->get(key_of(1)), other);
  const MemoryCache::Stats stats = cache->stats();
  EXPECT_EQ(stats.hits, 2u);
  EXPECT_EQ(stats.misses, 1u);
  EXPECT_EQ(stats.entries, 1u);
  EXPECT_EQ(stats.bytes, other->charged_bytes());
  cache->clear();
  EXPECT_EQ(cache->get(key_of(1)), nullptr);
  EXPECT_EQ(cache->stats().bytes, 0u);
}

TEST(MemoryCache, KeepsNothingWithoutBudgetAndNothingLargerThanAShard) {
  const auto none = MemoryCache::create(0);
  none->put(key_of(1), tile_of(1, 0));
  EXPECT_EQ(none->get(key_of(1)), nullptr);
  const auto small = MemoryCache::create(10000);
  small->put(key_of(1), tile_of(1, 500));
  small->put(key_of(2), tile_of(2, 20000));
  EXPECT_EQ(small->get(key_of(2)), nullptr);
  EXPECT_NE(small->get(key_of(1)), nullptr);
  small->put(key_of(1), tile_of(3, 20000));  // the old bytes of that key must not stay
  EXPECT_EQ(small->get(key_of(1)), nullptr);
  EXPECT_EQ(small->stats().bytes, 0u);
}

class RandomOperations : public ::testing::TestWithParam<std::size_t> {};

TEST_P(RandomOperations, NeverGiveAWrongTileNorBreakTheBudget) {
  const std::size_t budget_bytes = GetParam();
  const auto cache = MemoryCache::create(budget_bytes);
  std::unordered_map<std::uint64_t, CachedTilePtr> last;
  std::mt19937_64 random(budget_bytes);
  for (int step = 0; step < 40000; ++step) {
    const std::uint64_t number = random() % 3000;
    if (random() % 3 == 0) {
      const std::size_t limit = random() % 8 == 0 ? std::min<std::size_t>(budget_bytes / 4, 200000) : 2000;
      last[number] = tile_of(random(), random() % limit);
      cache->put(key_of(number), last[number]);
    } else if (const CachedTilePtr tile = cache->get(key_of(number))) {
      ASSERT_EQ(tile, last[number]) << "step " << step;
    }
    if (step % 64 == 0) {
      ASSERT_LE(cache->stats().bytes, budget_bytes) << "step " << step;
    }
    if (step % 20000 == 19999) cache->clear();
  }
  const MemoryCache::Stats stats = cache->stats();
  EXPECT_GT(stats.hits, 0u);
  EXPECT_GT(stats.evictions, 0u);
}
INSTANTIATE_TEST_SUITE_P(Budgets, RandomOperations, ::testing::Values(20000, 300000, std::size_t{17} << 20));

TEST(MemoryCache, KeepsTheHotSetThroughAScanOfTenBudgets) {
  constexpr std::size_t kBudget = std::size_t{16} << 20, kTile = 16384;
  const auto cache = MemoryCache::create(kBudget);
  const std::uint64_t hot = kBudget / 2 / kTile;
  for (std::uint64_t i = 0; i < hot; ++i) cache->put(key_of(i), tile_of(i, kTile));
  for (std::uint64_t i = 0; i < hot; ++i) ASSERT_NE(cache->get(key_of(i)), nullptr);
  for (std::uint64_t i = 0; i < 10 * kBudget / kTile; ++i) cache->put(key_of(1000000 + i), tile_of(i, kTile));
  std::uint64_t kept = 0;
  for (std::uint64_t i = 0; i < hot; ++i) kept += cache->get(key_of(i)) != nullptr;
  EXPECT_GE(kept, hot * 98 / 100) << "of " << hot;
}

TEST(MemoryCache, LetsANewHotSetReplaceAnOldOne) {
  constexpr std::size_t kBudget = std::size_t{8} << 20, kTile = 16384;
  const auto cache = MemoryCache::create(kBudget);
  const std::uint64_t hot = kBudget / 2 / kTile;
  std::uint64_t last_round_hits = 0;
  for (std::uint64_t phase = 0; phase < 3; ++phase) {
    for (int round = 0; round < 12; ++round) {
      last_round_hits = 0;
      for (std::uint64_t i = 0; i < hot; ++i) {
        const std::uint64_t number = phase * 100000 + i;
        if (cache->get(key_of(number))) {
          ++last_round_hits;
        } else {
          cache->put(key_of(number), tile_of(number, kTile));
        }
      }
    }
    EXPECT_GE(last_round_hits, hot * 95 / 100) << "phase " << phase;
  }
}

TEST(MemoryCache, ServesManyThreadsAtOnce) {
  const auto cache = MemoryCache::create(std::size_t{32} << 20);
  std::vector<std::thread> threads;
  std::atomic<int> wrong = 0;
  for (int t = 0; t < 4; ++t) {
    threads.emplace_back([&, t] {
      std::mt19937_64 random(t);
      for (int step = 0; step < 10000; ++step) {
        const std::uint64_t number = random() % 4000;
        if (const CachedTilePtr tile = cache->get(key_of(number))) {
          wrong += !tile->body.ends_with(std::to_string(number));
        } else {
          cache->put(key_of(number), tile_of(number, 9000 + number));
        }
        if (step % 5000 == 4999) cache->clear();
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(wrong, 0);
  EXPECT_LE(cache->stats().bytes, std::size_t{32} << 20);
}

}  // namespace
}  // namespace lodestone
