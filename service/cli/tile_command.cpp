// lodestone tile: the bytes that the daemon would serve, without a daemon.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <fstream>
#include <iostream>

#include "service/app/app.h"
#include "service/app/routes.h"
#include "service/cli/commands.h"

namespace lodestone {
namespace {

struct Flags {
  std::string layer, recipe, address, query, output;
};

// "z/x/y.ext?key=value" under /tiles/layer/recipe, as a request that tile_key_from() reads.
Result<TileKey> key_from(const Flags& flags, const Catalog& catalog) {
  const std::string path = "/tiles/" + flags.layer + "/" + flags.recipe + "/" + flags.address + (flags.query.empty() ? "" : "?" + flags.query);
  auto target = http::parse_target(path);
  if (!target) return target.error();
  const auto& segments = target->segments;
  if (segments.size() != 6 || segments[5].find('.') == std::string::npos) {
    return Error{ErrorCode::kInvalidArgument, "tile address " + flags.address + ": must be z/x/y.ext, for example 5/9/7.exr"};
  }
  http::Request request;
  request.target = *target;
  const auto dot = segments[5].rfind('.');
  request.params = {{"layer", segments[1]}, {"recipe", segments[2]}, {"z", segments[3]}, {"x", segments[4]},
                    {"y", segments[5].substr(0, dot)}, {"ext", segments[5].substr(dot + 1)}};
  return tile_key_from(catalog, request);
}

int run(const Flags& flags, const CommonFlags& common) {
  auto options = common.load();
  if (!options) return fail(options.error());
  auto layer = Layer::open(options->data_dir, flags.layer, std::size_t{64} << 20, std::size_t{64} << 20);
  if (!layer) return fail(layer.error());
  Catalog catalog{.recipes = options->recipes};
  catalog.layers.emplace(flags.layer, *layer);
  auto key = key_from(flags, catalog);
  if (!key) return fail(key.error());
  auto device = open_device(*options);
  if (!device) return fail(device.error());
  auto ground = GroundMaker::create(*device);
  if (!ground) return fail(ground.error());
  TileMaker maker(std::move(*ground));
  const auto made = maker.make(std::span(&*key, 1));
  if (!made[0]) return fail(made[0].error());
  const std::string& body = made[0]->tile->body;
  if (flags.output == "-") {
    std::cout.write(body.data(), static_cast<std::streamsize>(body.size()));
    return std::cout.flush() ? kDone : fail({ErrorCode::kIo, "standard output does not take the tile"});
  }
  const std::string temporary = flags.output + ".tmp";
  std::ofstream file(temporary, std::ios::binary);
  file.write(body.data(), static_cast<std::streamsize>(body.size()));
  file.close();
  std::error_code code;
  if (file) std::filesystem::rename(temporary, flags.output, code);
  if (!file || code) {
    std::error_code ignored;
    std::filesystem::remove(temporary, ignored);
    return fail({ErrorCode::kIo, "cannot write " + flags.output + (code ? ": " + code.message() : "")});
  }
  fmt::print("{}: {} bytes\n", flags.output, body.size());
  return kDone;
}

}  // namespace

Run declare_tile(CLI::App& command, CommonFlags& common) {
  auto flags = std::make_shared<Flags>();
  command.add_option("LAYER", flags->layer, "Name of the layer")->required();
  command.add_option("RECIPE", flags->recipe, "Name of the recipe")->required();
  command.add_option("ADDRESS", flags->address, "z/x/y.ext, for example 5/9/7.exr")->required();
  command.add_option("--query", flags->query, "Options as in the URL, for example \"seed=7&compression=zip\"");
  command.add_option("-o,--output", flags->output, "File to write; - for standard output")->required();
  return [flags, &common] { return run(*flags, common); };
}

}  // namespace lodestone
