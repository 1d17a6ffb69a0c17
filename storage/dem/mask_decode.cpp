#include "storage/dem/mask_decode.h"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>
#include <cpl_error.h>
#include <cpl_vsi.h>
#include <gdal_priv.h>
#include <ogr_spatialref.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstring>
#include <exception>
#include <limits>
#include <memory>

#include "storage/dem/raster_source.h"

namespace lodestone {
namespace {

constexpr std::int64_t kMaxPixels = std::int64_t{1} << 26;
constexpr std::int64_t kMaxSide = 65536;
constexpr std::size_t kMaxBytes = std::size_t{1} << 28;
constexpr std::int64_t kMaxBlockBytes = std::int64_t{1} << 28;
constexpr int kMaxChannels = 16;
constexpr int kRowsAtOnce = 64;

Result<void> check_size(std::int64_t width, std::int64_t height, int channels) {
  if (width < 1 || height < 1) return Error{ErrorCode::kCorrupt, "mask: it has no pixels"};
  if (width > kMaxSide || height > kMaxSide || width * height > kMaxPixels || channels > kMaxChannels) {
    return Error{ErrorCode::kTooLarge,
                 "mask: " + std::to_string(width) + " x " + std::to_string(height) + " pixels of " +
                     std::to_string(channels) +
                     " channels declared; at most 2^26 pixels, 65536 a side, 16 channels; send it coarser"};
  }
  return {};
}

// 0..1 to 0..255, NaN to 0.
std::uint8_t byte_from_grey(double grey) {
  if (!(grey > 0)) return 0;
  return static_cast<std::uint8_t>(std::min(grey, 1.0) * 255 + 0.5);
}

// An integer raster whose largest value is 1 is a 0/1 mask: 1 is white, not 1/255.
void widen_binary(std::vector<std::uint8_t>& pixels) {
  if (std::any_of(pixels.begin(), pixels.end(), [](std::uint8_t v) { return v > 1; })) return;
  for (std::uint8_t& v : pixels) v = v != 0 ? 255 : 0;
}

// PNG and EXR by OpenImageIO, a few rows at a time.
Result<GreyRaster> decode_image(std::span<const std::uint8_t> bytes, const std::string& name) {
  const auto corrupt = [&](const std::string& why) {
    return Error{ErrorCode::kCorrupt, "mask: " + name + " does not decode: " +
                                          (why.empty() ? std::string("unknown reason") : why)};
  };
  try {
    OIIO::Filesystem::IOMemReader memory(const_cast<std::uint8_t*>(bytes.data()), bytes.size());
    OIIO::ImageSpec config;
    OIIO::Filesystem::IOProxy* proxy = &memory;
    config.attribute("oiio:ioproxy", OIIO::TypeDesc::PTR, &proxy);
    config.attribute("oiio:UnassociatedAlpha", 1);  // or colours come multiplied by alpha
    const auto input = OIIO::ImageInput::create("mask." + name, false, &config, &memory);
    if (!input) return Error{ErrorCode::kUnsupported, "mask: no reader for " + name};
    OIIO::ImageSpec spec;
    if (!input->open("mask." + name, spec, config)) return corrupt(input->geterror());
    if (auto ok = check_size(spec.width, spec.height, spec.nchannels); !ok) return ok.error();
    if (spec.deep || spec.depth > 1)
      return Error{ErrorCode::kUnsupported, "mask: deep and volume images are no masks"};
    if (spec.tile_width > kMaxSide || spec.tile_height > kMaxSide ||
        static_cast<std::int64_t>(std::max(spec.tile_width, 1)) * std::max(spec.tile_height, 1) >
            kMaxPixels) {
      return Error{ErrorCode::kTooLarge, "mask: its tiles are larger than any mask"};
    }

    std::vector<int> channels;
    for (int c = 0; c < spec.nchannels && channels.size() < 3; ++c) {
      if (c != spec.alpha_channel && c != spec.z_channel) channels.push_back(c);
    }
    if (channels.empty()) channels.push_back(0);
    const auto width = static_cast<std::size_t>(spec.width), all = static_cast<std::size_t>(spec.nchannels);
    GreyRaster out;
    out.width = spec.width;
    out.height = spec.height;
    out.pixels.resize(width * static_cast<std::size_t>(spec.height));
    const bool is_byte = spec.format == OIIO::TypeDesc::UINT8;
    const int step = spec.tile_height > 0 ? spec.tile_height : kRowsAtOnce;
    std::vector<float> rows;
    for (int y = 0; y < spec.height; y += step) {
      const int n = std::min(step, spec.height - y);
      rows.assign(width * static_cast<std::size_t>(n) * all, 0.0F);
      const bool ok =
          spec.tile_width > 0
              ? input->read_tiles(0, 0, spec.x, spec.x + spec.width, spec.y + y, spec.y + y + n, spec.z,
                                  spec.z + 1, 0, spec.nchannels, OIIO::TypeDesc::FLOAT, rows.data())
              : input->read_scanlines(0, 0, spec.y + y, spec.y + y + n, spec.z, 0, spec.nchannels,
                                      OIIO::TypeDesc::FLOAT, rows.data());
      if (!ok) return corrupt(input->geterror());
      for (std::size_t k = 0; k < width * static_cast<std::size_t>(n); ++k) {
        double sum = 0;
        for (const int c : channels) {
          const float v = rows[k * all + static_cast<std::size_t>(c)];
          sum += v > 0 ? std::min(static_cast<double>(v), 1.0) : 0.0;
        }
        out.pixels[static_cast<std::size_t>(y) * width + k] =
            byte_from_grey(sum / static_cast<double>(channels.size()));
      }
    }
    input->close();
    if (is_byte) widen_binary(out.pixels);
    return out;
  } catch (const std::exception& e) {
    return corrupt(e.what());
  }
}

struct MemoryFile {
  explicit MemoryFile(std::span<const std::uint8_t> bytes) {
    static std::atomic<std::uint64_t> serial{0};
    path = "/vsimem/lodestone-mask-" + std::to_string(serial++) + ".tif";
    VSIFCloseL(VSIFileFromMemBuffer(path.c_str(), const_cast<GByte*>(bytes.data()), bytes.size(), FALSE));
  }
  ~MemoryFile() { VSIUnlink(path.c_str()); }
  MemoryFile(const MemoryFile&) = delete;
  MemoryFile& operator=(const MemoryFile&) = delete;
  std::string path;
};

// White of a band's type in raw values: the type's largest value, 1 for floats and wide integers.
double white_of(GDALDataType type) {
  switch (type) {
    case GDT_Byte:
      return 255;
    case GDT_UInt16:
      return 65535;
    case GDT_Int16:
      return 32767;
    default:
      return 1;
  }
}

Result<GreyRaster> decode_geotiff(std::span<const std::uint8_t> bytes) {
  prepare_gdal();
  const QuietGdal quiet;
  const MemoryFile file(bytes);
  const char* drivers[] = {"GTiff", nullptr};
  CPLErrorReset();
  const DatasetPtr dataset(static_cast<GDALDataset*>(
      GDALOpenEx(file.path.c_str(), GDAL_OF_RASTER | GDAL_OF_READONLY | GDAL_OF_VERBOSE_ERROR, drivers,
                 nullptr, nullptr)));
  const auto corrupt = [] {
    return Error{ErrorCode::kCorrupt, std::string("mask: GeoTIFF does not decode: ") + CPLGetLastErrorMsg()};
  };
  if (!dataset) return corrupt();
  if (auto ok = check_size(dataset->GetRasterXSize(), dataset->GetRasterYSize(), dataset->GetRasterCount());
      !ok)
    return ok.error();
  if (dataset->GetRasterCount() < 1) return Error{ErrorCode::kUnsupported, "mask: GeoTIFF without bands"};
  std::vector<GDALRasterBand*> bands;
  for (int b = 1; b <= dataset->GetRasterCount() && bands.size() < 3; ++b) {
    GDALRasterBand* band = dataset->GetRasterBand(b);
    if (band->GetColorInterpretation() == GCI_AlphaBand) continue;
    int block_width = 0, block_height = 0;
    band->GetBlockSize(&block_width, &block_height);
    const GDALDataType type = band->GetRasterDataType();
    if (static_cast<std::int64_t>(block_width) * block_height * GDALGetDataTypeSizeBytes(type) *
            dataset->GetRasterCount() >
        kMaxBlockBytes) {
      return Error{ErrorCode::kTooLarge, "mask: GeoTIFF blocks over 2^28 bytes; write it with -co TILED=YES"};
    }
    if (GDALDataTypeIsComplex(type))
      return Error{ErrorCode::kUnsupported, "mask: complex numbers are no grey"};
    if (band->GetColorTable() != nullptr) {
      return Error{ErrorCode::kUnsupported,
                   "mask: it has a colour table; expand it with gdal_translate -expand gray"};
    }
    bands.push_back(band);
  }
  if (bands.empty()) return Error{ErrorCode::kUnsupported, "mask: GeoTIFF with an alpha band only"};

  GreyRaster out;
  out.width = dataset->GetRasterXSize();
  out.height = dataset->GetRasterYSize();
  const auto width = static_cast<std::size_t>(out.width);
  out.pixels.resize(width * static_cast<std::size_t>(out.height));
  const bool is_grey = bands.size() < 3;  // grey, or colour
  if (is_grey) bands.resize(1);
  double largest = 0;  // raw value of all bands
  bool is_integer = true;
  for (const GDALRasterBand* band : bands)
    is_integer &= !GDALDataTypeIsFloating(const_cast<GDALRasterBand*>(band)->GetRasterDataType());
  std::vector<double> rows;
  std::vector<double> sum;
  // Two passes for integers: a 0/1 raster is known by its largest value only.
  for (int pass = is_integer ? 0 : 1; pass < 2; ++pass) {
    for (int y = 0; y < out.height; y += kRowsAtOnce) {
      const int n = std::min(kRowsAtOnce, out.height - y);
      const std::size_t count = width * static_cast<std::size_t>(n);
      sum.assign(count, 0.0);
      for (GDALRasterBand* band : bands) {
        rows.resize(count);
        if (band->RasterIO(GF_Read, 0, y, out.width, n, rows.data(), out.width, n, GDT_Float64, 0, 0,
                           nullptr) != CE_None)
          return corrupt();
        int has = 0;
        const double nodata = band->GetNoDataValue(&has);
        const double white = is_integer && largest <= 1 ? 1 : white_of(band->GetRasterDataType());
        for (std::size_t k = 0; k < count; ++k) {
          const double v = has != 0 && rows[k] == nodata ? 0 : rows[k];
          if (pass == 0)
            largest = std::max(largest, v);
          else
            sum[k] += v > 0 ? std::min(v / white, 1.0) : 0.0;
        }
      }
      if (pass == 0) continue;
      for (std::size_t k = 0; k < count; ++k) {
        out.pixels[static_cast<std::size_t>(y) * width + k] =
            byte_from_grey(sum[k] / static_cast<double>(bands.size()));
      }
    }
  }

  std::array<double, 6> transform{};
  if (dataset->GetGeoTransform(transform.data()) == CE_None) {
    const double det = transform[1] * transform[5] - transform[2] * transform[4];
    if (!std::isfinite(det) || det == 0 || !std::isfinite(transform[0]) || !std::isfinite(transform[3])) {
      return Error{ErrorCode::kCorrupt, "mask: its geotransform has no area"};
    }
    out.transform = transform;
    if (const OGRSpatialReference* crs = dataset->GetSpatialRef(); crs != nullptr && !crs->IsEmpty()) {
      char* wkt = nullptr;
      const char* options[] = {"FORMAT=WKT2_2018", nullptr};
      if (crs->exportToWkt(&wkt, options) == OGRERR_NONE) out.crs_wkt = wkt;
      CPLFree(wkt);
    }
  }
  return out;
}

bool starts_with(std::span<const std::uint8_t> bytes, std::initializer_list<int> magic) {
  return bytes.size() >= magic.size() &&
         std::equal(magic.begin(), magic.end(), bytes.begin(), [](int m, std::uint8_t b) { return m == b; });
}

}  // namespace

Result<GreyRaster> decode_mask(std::span<const std::uint8_t> bytes) {
  if (bytes.size() > kMaxBytes) {
    return Error{ErrorCode::kTooLarge, "mask: " + std::to_string(bytes.size()) + " bytes sent, at most 2^28"};
  }
  if (starts_with(bytes, {0x89, 'P', 'N', 'G', '\r', '\n', 0x1A, '\n'})) {
    // OpenImageIO allocates by the header: look at it first.
    if (bytes.size() < 33) return Error{ErrorCode::kCorrupt, "mask: PNG ends within its header"};
    const auto big = [&](std::size_t at) {
      return std::int64_t{bytes[at]} << 24 | std::int64_t{bytes[at + 1]} << 16 |
             std::int64_t{bytes[at + 2]} << 8 | std::int64_t{bytes[at + 3]};
    };
    if (auto ok = check_size(big(16), big(20), 1); !ok) return ok.error();
    return decode_image(bytes, "png");
  }
  if (starts_with(bytes, {0x76, 0x2F, 0x31, 0x01})) return decode_image(bytes, "exr");
  if (starts_with(bytes, {'I', 'I', 42, 0}) || starts_with(bytes, {'M', 'M', 0, 42}) ||
      starts_with(bytes, {'I', 'I', 43, 0}) || starts_with(bytes, {'M', 'M', 0, 43})) {
    return decode_geotiff(bytes);
  }
  return Error{ErrorCode::kUnsupported, "mask: neither PNG, EXR nor TIFF by its first bytes"};
}

}  // namespace lodestone
