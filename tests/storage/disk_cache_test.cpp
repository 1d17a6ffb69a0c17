#include "storage/cache/disk_cache.h"

#include <atomic>
#include <thread>

#include "tests/support/disk_cache_fixture.h"

namespace lodestone {
namespace {

constexpr std::uint64_t kMiB = 1 << 20;

TEST_F(DiskCacheTest, KeepsTilesOverARestart) {
  {
    const auto cache = DiskCache::open(options());
    EXPECT_TRUE(cache->stats().is_writable) << cache->stats().last_error;
    fill(*cache, 0, 100);
    EXPECT_EQ(count_right(*cache, 0, 100), 100u);
    EXPECT_EQ(cache->stats().entries, 100u);
  }
  const auto cache = DiskCache::open(options());
  EXPECT_EQ(cache->stats().entries, 100u);
  EXPECT_EQ(count_right(*cache, 0, 100), 100u);
  EXPECT_EQ(cache->get(disk_key(100)), nullptr);
  EXPECT_EQ(cache->stats().hits, 100u);
  EXPECT_EQ(cache->stats().misses, 1u);
  EXPECT_EQ(cache->stats().corrupt, 0u);
}

TEST_F(DiskCacheTest, WritesWhatIsQueuedWhenItCloses) {
  { DiskCache::open(options())->put(disk_key(5), "a", disk_tile(5)); }
  EXPECT_EQ(count_right(*DiskCache::open(options()), 5, 1), 1u);
}

TEST_F(DiskCacheTest, CommitsWithoutAFlush) {
  const auto cache = DiskCache::open(options());
  cache->put(disk_key(5), "a", disk_tile(5));
  for (int i = 0; i < 200 && cache->stats().writes == 0; ++i) std::this_thread::sleep_for(std::chrono::milliseconds(10));
  EXPECT_EQ(cache->stats().writes, 1u);
  EXPECT_EQ(count_right(*cache, 5, 1), 1u);
}

TEST_F(DiskCacheTest, DropsTheTilesOfAnotherKernelVersion) {
  { fill(*DiskCache::open(options()), 0, 20); }
  DiskCacheOptions other = options();
  other.kernel_hash = 78;
  {
    const auto cache = DiskCache::open(other);
    EXPECT_EQ(cache->stats().entries, 0u);
    EXPECT_EQ(cache->stats().corrupt, 0u);
    EXPECT_EQ(count_right(*cache, 0, 20), 0u);
    fill(*cache, 0, 20);
  }
  EXPECT_EQ(count_right(*DiskCache::open(other), 0, 20), 20u);
}

TEST_F(DiskCacheTest, PurgesByTagAndBelow) {
  const auto cache = DiskCache::open(options());
  fill(*cache, 0, 50, "alps/gsa");
  fill(*cache, 100, 50, "alps/lsa");
  fill(*cache, 200, 50, "alps");
  fill(*cache, 300, 50, "alpstein/gsa");
  const Result<std::uint64_t> one = cache->purge("alps/gsa");
  ASSERT_TRUE(one) << one.error().message;
  EXPECT_EQ(*one, 50u);
  EXPECT_EQ(count_right(*cache, 0, 50), 0u);
  const Result<std::uint64_t> layer = cache->purge("alps");
  ASSERT_TRUE(layer);
  EXPECT_EQ(*layer, 100u);
  EXPECT_EQ(count_right(*cache, 300, 50), 50u);
  EXPECT_EQ(cache->stats().entries, 50u);
  const Result<std::uint64_t> all = cache->purge("");
  ASSERT_TRUE(all);
  EXPECT_EQ(*all, 50u);
  EXPECT_EQ(count_right(*cache, 300, 50), 0u);
  EXPECT_EQ(cache->stats().bytes, 0u);
  fill(*cache, 0, 10);
  EXPECT_EQ(count_right(*cache, 0, 10), 10u);
}

TEST_F(DiskCacheTest, PurgeRemovesWhatWasQueuedBefore) {
  const auto cache = DiskCache::open(options());
  for (std::uint64_t i = 0; i < 100; ++i) cache->put(disk_key(i), "x", disk_tile(i));
  const Result<std::uint64_t> removed = cache->purge("x");
  ASSERT_TRUE(removed);
  EXPECT_EQ(*removed, 100u);
  EXPECT_EQ(cache->stats().entries, 0u);
}

TEST_F(DiskCacheTest, TheLastPutOfAKeyWins) {
  const auto cache = DiskCache::open(options());
  cache->put(disk_key(1), "a", disk_tile(11));
  cache->put(disk_key(1), "b", disk_tile(12));
  cache->flush();
  ASSERT_NE(cache->get(disk_key(1)), nullptr);
  EXPECT_TRUE(is_disk_tile(*cache->get(disk_key(1)), 12));
  cache->put(disk_key(1), "c", disk_tile(13));
  cache->flush();
  EXPECT_TRUE(is_disk_tile(*cache->get(disk_key(1)), 13));
  EXPECT_EQ(cache->stats().entries, 1u);
  EXPECT_EQ(*cache->purge("b"), 0u);
  EXPECT_EQ(*cache->purge("c"), 1u);
}

TEST_F(DiskCacheTest, RefusesWhatItCannotHold) {
  DiskCacheOptions tight = options();
  tight.queue_bytes = 100000;
  const auto cache = DiskCache::open(tight);
  auto huge = std::make_shared<CachedTile>();
  huge->body.resize(2 * kMiB);
  cache->put(disk_key(1), "a", huge);
  cache->put(disk_key(2), std::string(5000, 't'), disk_tile(2));
  EXPECT_EQ(cache->stats().dropped_writes, 2u);
  const CachedTilePtr tile = disk_tile(3);  // 20 KB, put faster than the writer can follow
  for (std::uint64_t i = 0; i < 500; ++i) cache->put(disk_key(1000 + i), "a", tile);
  cache->flush();
  const DiskCache::Stats stats = cache->stats();
  EXPECT_GT(stats.dropped_writes, 2u);
  EXPECT_EQ(stats.writes + stats.dropped_writes, 502u);
}

TEST_F(DiskCacheTest, IsOffWithoutABudget) {
  const auto cache = DiskCache::open(options(0));
  cache->put(disk_key(1), "a", disk_tile(1));
  cache->flush();
  EXPECT_EQ(cache->get(disk_key(1)), nullptr);
  EXPECT_FALSE(cache->stats().is_writable);
  EXPECT_EQ(cache->stats().dropped_writes, 1u);
}

class RandomDiskOperations : public DiskCacheTest, public ::testing::WithParamInterface<std::uint64_t> {};

TEST_P(RandomDiskOperations, NeverGiveAWrongByteNorBreakTheBudget) {
  const std::uint64_t budget_bytes = GetParam();
  auto cache = DiskCache::open(options(budget_bytes));
  std::mt19937_64 random(budget_bytes);
  std::uint64_t hits = 0, evictions = 0;
  for (int step = 0; step < 12000; ++step) {
    const std::uint64_t number = random() % 6000;
    const int what = random() % 1000;
    if (what < 500) {
      cache->put(disk_key(number), "tag/" + std::to_string(number % 10), disk_tile(number));
    } else if (what < 990) {
      hits += count_right(*cache, number, 1);
    } else if (what < 993) {
      ASSERT_TRUE(cache->purge("tag/" + std::to_string(random() % 10)));
    } else if (what < 998) {
      cache->flush();
    } else {
      evictions += cache->stats().evictions;
      ASSERT_EQ(cache->stats().corrupt, 0u) << cache->stats().last_error;
      cache.reset();
      cache = DiskCache::open(options(budget_bytes));
    }
    if (step % 50 == 0) {
      ASSERT_EQ(cache->stats().last_error, "") << "step " << step;  // never so full that it had to start anew
      ASSERT_LE(std::filesystem::file_size(data_file()), budget_bytes + budget_bytes / 4 + kMiB) << "step " << step;
      ASSERT_LE(cache->stats().bytes, budget_bytes);
    }
  }
  cache->flush();
  evictions += cache->stats().evictions;
  EXPECT_GT(hits, 100u);
  EXPECT_GT(evictions, 0u);
  EXPECT_EQ(cache->stats().corrupt, 0u) << cache->stats().last_error;
  EXPECT_EQ(cache->stats().write_errors, 0u);
  EXPECT_EQ(cache->stats().last_error, "");  // never so full that it had to start anew
  cache.reset();
  const Result<DiskCacheReport> report = verify_disk_cache(directory(), false);
  ASSERT_TRUE(report) << report.error().message;
  EXPECT_EQ(report->corrupt, 0u);
  EXPECT_GT(report->entries, 0u);
  EXPECT_LE(report->bytes, budget_bytes);
}
INSTANTIATE_TEST_SUITE_P(Budgets, RandomDiskOperations, ::testing::Values(2 * kMiB, 5 * kMiB));

TEST_F(DiskCacheTest, UsesMostOfItsBudgetAndKeepsWhatIsUsed) {
  const auto cache = DiskCache::open(options(8 * kMiB));
  fill(*cache, 0, 150);
  for (int round = 0; round < 40; ++round) {
    fill(*cache, 1000 + 100 * round, 100);
    count_right(*cache, 0, 150);
  }
  EXPECT_GE(count_right(*cache, 0, 150), 140u);
  EXPECT_GT(cache->stats().bytes, 7 * kMiB);
  EXPECT_GT(cache->stats().evictions, 1000u);
}

TEST_F(DiskCacheTest, FollowsAChangedBudget) {
  { fill(*DiskCache::open(options(16 * kMiB)), 0, 1500); }
  EXPECT_GT(std::filesystem::file_size(data_file()), 8 * kMiB);
  {
    const auto cache = DiskCache::open(options(4 * kMiB));
    EXPECT_TRUE(cache->stats().is_writable) << cache->stats().last_error;
    EXPECT_LE(cache->stats().bytes, 4 * kMiB);
    EXPECT_LE(std::filesystem::file_size(data_file()), 6 * kMiB);
    EXPECT_GT(count_right(*cache, 0, 1500), 200u);
    fill(*cache, 5000, 300);
    EXPECT_LE(std::filesystem::file_size(data_file()), 6 * kMiB);
  }
  const auto cache = DiskCache::open(options(16 * kMiB));
  const std::uint64_t before = cache->stats().entries;
  fill(*cache, 7000, 600);
  EXPECT_EQ(cache->stats().entries, before + 600);
}

TEST_F(DiskCacheTest, AllowsOneOwnerOfADirectory) {
  auto first = DiskCache::open(options());
  fill(*first, 0, 10);
  const auto second = DiskCache::open(options());
  EXPECT_FALSE(second->stats().is_writable);
  EXPECT_NE(second->stats().last_error.find("in use"), std::string::npos) << second->stats().last_error;
  EXPECT_EQ(second->get(disk_key(1)), nullptr);
  const Result<DiskCacheReport> report = verify_disk_cache(directory(), false);
  ASSERT_FALSE(report);
  EXPECT_EQ(report.error().code, ErrorCode::kConflict);
  first.reset();
  for (int i = 0; i < 100 && !second->stats().is_writable; ++i) std::this_thread::sleep_for(std::chrono::milliseconds(100));
  EXPECT_EQ(count_right(*second, 0, 10), 10u);
}

TEST_F(DiskCacheTest, ServesManyThreadsAtOnce) {
  const auto cache = DiskCache::open(options(4 * kMiB));
  std::atomic<std::uint64_t> right = 0, wrong = 0;
  std::vector<std::thread> threads;
  for (int t = 0; t < 4; ++t) {
    threads.emplace_back([&, t] {
      std::mt19937_64 random(t);
      for (int step = 0; step < 3000; ++step) {
        const std::uint64_t number = random() % 1500;
        if (const CachedTilePtr tile = cache->get(disk_key(number))) {
          ++(is_disk_tile(*tile, number) ? right : wrong);
        } else {
          cache->put(disk_key(number), t % 2 ? "odd" : "even", disk_tile(number));
        }
        if (step % 1000 == 999) cache->flush();
        if (t == 0 && step % 1000 == 500) (void)cache->purge(step < 2000 ? "odd" : "");
        if (step % 100 == 0) (void)cache->stats();
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(wrong, 0u);
  EXPECT_GT(right, 100u);
  EXPECT_EQ(cache->stats().corrupt, 0u) << cache->stats().last_error;
  EXPECT_EQ(cache->stats().read_errors, 0u);
}

}  // namespace
}  // namespace lodestone
