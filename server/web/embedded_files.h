// The files of the status page, which are compiled into the program; see cmake/EmbedFiles.cmake.
//
// Thread-safe.
#pragma once

#include <map>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Returns the contents of the files by their path below server/web/static, such as "index.html" or
// "vendor/uplot/uPlot.min.css".
const std::map<absl::string_view, absl::string_view>& EmbeddedFiles();

}  // namespace spikeserve
