// Single flight, cancellation, the bounded queue and priorities, on a layer of the packaged sample.

#include "service/tiles/tile_service.h"

#include <gtest/gtest.h>

#include <condition_variable>
#include <future>
#include <mutex>
#include <random>
#include <thread>

#include "tests/support/layers.h"

namespace lodestone {
namespace {

class TileServiceTest : public ::testing::Test {
 protected:
  static void SetUpTestSuite() {
    dir_ = new test::DataDir();
    layer_ = new std::shared_ptr<const Layer>(dir_->ingest_and_open({"jacksboro", {LODESTONE_SOURCE_DIR "/config/jacksboro.vrt"}}));
  }
  static void TearDownTestSuite() {
    delete layer_;
    delete dir_;
  }

  static TileKey key(std::int64_t x, std::int64_t y, std::uint64_t seed = 1) {
    TileKey key;
    key.layer = *layer_;
    key.recipe_name = "lsa";
    key.recipe = fixed_recipes().at("lsa");
    key.seed = seed;
    key.id = {5, x, y};
    key.format = TileFormat::kF32;
    return key;
  }

  static std::unique_ptr<TileService> service(int queue_tiles = 64, std::chrono::milliseconds timeout = std::chrono::seconds(60)) {
    TileServiceOptions options;
    options.workers = 1;
    options.queue_tiles = queue_tiles;
    options.timeout = timeout;
    options.memory_cache_bytes = std::size_t{64} << 20;
    options.disk.budget_bytes = 0;
    auto made = TileService::create(nullptr, options);
    EXPECT_TRUE(made);
    return std::move(*made);
  }

  // Keeps the only worker busy until release() is called.
  class Blocker {
   public:
    explicit Blocker(TileService& service) {
      service.post([this](TileMaker&) {
        started_.set_value();
        released_.get_future().wait();
      });
      started_.get_future().wait();
    }
    void release() { released_.set_value(); }

   private:
    std::promise<void> started_, released_;
  };

  static test::DataDir* dir_;
  static std::shared_ptr<const Layer>* layer_;
};
test::DataDir* TileServiceTest::dir_ = nullptr;
std::shared_ptr<const Layer>* TileServiceTest::layer_ = nullptr;

TEST_F(TileServiceTest, ManyWaitersShareOneComputationAndOneBody) {
  const auto tiles = service();
  Blocker blocker(*tiles);
  std::vector<std::promise<TileAnswer>> answers(50);
  for (auto& answer : answers) tiles->get(key(1, 1), Priority::kInteractive, [&](TileAnswer a) { answer.set_value(std::move(a)); });
  blocker.release();
  const TileAnswer first = answers[0].get_future().get();
  ASSERT_TRUE(first.tile);
  for (std::size_t n = 1; n < answers.size(); ++n) {
    const TileAnswer other = answers[n].get_future().get();
    ASSERT_TRUE(other.tile);
    EXPECT_EQ(other.tile->get(), first.tile->get());
  }
  EXPECT_EQ(tiles->counters().tiles_generated_total, 1U);
  EXPECT_EQ(tiles->counters().tiles_joined_total, 49U);
}

TEST_F(TileServiceTest, AnErrorOfTheLeaderReachesAllWaiters) {
  const auto tiles = service();
  Blocker blocker(*tiles);
  TileKey outside = key(0, 0);
  outside.id = {5, 4000, 4000};
  std::vector<std::promise<TileAnswer>> answers(5);
  for (auto& answer : answers) tiles->get(outside, Priority::kInteractive, [&](TileAnswer a) { answer.set_value(std::move(a)); });
  blocker.release();
  for (auto& answer : answers) {
    const TileAnswer a = answer.get_future().get();
    ASSERT_FALSE(a.tile);
    EXPECT_EQ(a.tile.error().code, ErrorCode::kNotFound);
  }
  EXPECT_EQ(tiles->counters().tiles_failed_total, 1U);
}

TEST_F(TileServiceTest, TheLastWaiterThatLeavesCancelsTheWork) {
  const auto tiles = service();
  Blocker blocker(*tiles);
  std::atomic<int> called{0};
  const auto first = tiles->get(key(2, 2), Priority::kInteractive, [&](const TileAnswer&) { ++called; });
  const auto second = tiles->get(key(2, 2), Priority::kInteractive, [&](const TileAnswer&) { ++called; });
  tiles->leave(first);
  EXPECT_EQ(tiles->queue_length(), 1U);
  tiles->leave(second);
  EXPECT_EQ(tiles->queue_length(), 0U);
  EXPECT_EQ(tiles->counters().tiles_cancelled_total, 1U);
  blocker.release();
  EXPECT_TRUE(tiles->drain(std::chrono::seconds(30)));
  EXPECT_EQ(called, 0);
  EXPECT_EQ(tiles->counters().tiles_generated_total, 0U);
}

TEST_F(TileServiceTest, AFullQueueRefusesAndRecovers) {
  const auto tiles = service(2);
  Blocker blocker(*tiles);
  std::vector<std::promise<TileAnswer>> answers(3);
  for (std::int64_t n = 0; n < 3; ++n) {
    tiles->get(key(n, 3), Priority::kInteractive, [&answers, n](TileAnswer a) { answers[static_cast<std::size_t>(n)].set_value(std::move(a)); });
  }
  const TileAnswer refused = answers[2].get_future().get();
  ASSERT_FALSE(refused.tile);
  EXPECT_EQ(refused.tile.error().code, ErrorCode::kOverloaded);
  EXPECT_GE(tiles->retry_after_s(), 1);
  blocker.release();
  EXPECT_TRUE(answers[0].get_future().get().tile);
  EXPECT_TRUE(answers[1].get_future().get().tile);
  std::promise<TileAnswer> again;
  tiles->get(key(2, 3), Priority::kInteractive, [&](TileAnswer a) { again.set_value(std::move(a)); });
  EXPECT_TRUE(again.get_future().get().tile);
}

TEST_F(TileServiceTest, InteractiveTilesOvertakePrecomputedOnes) {
  const auto tiles = service();
  Blocker blocker(*tiles);
  std::mutex mutex;
  std::vector<int> order;
  std::vector<std::promise<void>> done(7);
  const auto ask = [&](int n, Priority priority) {
    tiles->get(key(n, 4), priority, [&, n](const TileAnswer&) {
      {
        const std::lock_guard lock(mutex);
        order.push_back(n);
      }
      done[static_cast<std::size_t>(n)].set_value();
    });
  };
  for (int n = 0; n < 5; ++n) ask(n, Priority::kPrecompute);
  ask(5, Priority::kPrefetch);
  ask(6, Priority::kInteractive);
  blocker.release();
  for (auto& one : done) one.get_future().wait();
  EXPECT_EQ(order[0], 6);
  EXPECT_EQ(order[1], 5);
}

TEST_F(TileServiceTest, AWaiterThatWaitsTooLongIsToldSo) {
  const auto tiles = service(64, std::chrono::milliseconds(50));
  Blocker blocker(*tiles);
  std::promise<TileAnswer> late;
  tiles->get(key(6, 6), Priority::kInteractive, [&](TileAnswer a) { late.set_value(std::move(a)); });
  const TileAnswer answer = late.get_future().get();
  ASSERT_FALSE(answer.tile);
  EXPECT_EQ(answer.tile.error().code, ErrorCode::kOverloaded);
  EXPECT_EQ(tiles->counters().tiles_timed_out_total, 1U);
  blocker.release();
}

TEST_F(TileServiceTest, StoppingAnswersEverybodyWhoWaits) {
  auto tiles = service();
  auto blocker = std::make_unique<Blocker>(*tiles);
  std::promise<TileAnswer> waiting;
  tiles->get(key(7, 7), Priority::kInteractive, [&](TileAnswer a) { waiting.set_value(std::move(a)); });
  std::thread stop([&] { tiles.reset(); });
  const TileAnswer answer = waiting.get_future().get();
  ASSERT_FALSE(answer.tile);
  EXPECT_EQ(answer.tile.error().code, ErrorCode::kCancelled);
  blocker->release();
  stop.join();
}

TEST_F(TileServiceTest, ThreadsThatAskAndLeaveAtRandomLoseNobody) {
  const auto tiles = service(4096);
  std::atomic<int> answered{0};
  std::atomic<int> left{0};
  std::vector<std::thread> clients;
  constexpr int kAsks = 60;
  for (int c = 0; c < 4; ++c) {
    clients.emplace_back([&, c] {
      std::mt19937 random(static_cast<unsigned>(c));
      for (int n = 0; n < kAsks; ++n) {
        const auto ticket = tiles->get(key(random() % 4, random() % 4), Priority::kInteractive, [&](const TileAnswer&) { ++answered; });
        if (ticket != 0 && random() % 4 == 0) {
          tiles->leave(ticket);
          ++left;
        }
      }
    });
  }
  for (std::thread& client : clients) client.join();
  EXPECT_TRUE(tiles->drain(std::chrono::seconds(60)));
  // Everyone was answered, but for those who left in time.
  EXPECT_LE(answered, 4 * kAsks);
  EXPECT_GE(answered + left, 4 * kAsks);
}

}  // namespace
}  // namespace lodestone
