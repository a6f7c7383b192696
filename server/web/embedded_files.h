// The files of the status page, which travel inside the program; see cmake/EmbedFiles.cmake.
//
// Thread-safe.
#ifndef SERVER_WEB_EMBEDDED_FILES_H_
#define SERVER_WEB_EMBEDDED_FILES_H_

#include <map>

#include "absl/strings/string_view.h"

namespace spikeserve {

// Bytes by name, as below server/web: "index.html", "vendor/uplot/uPlot.min.css".
const std::map<absl::string_view, absl::string_view>& EmbeddedFiles();

}  // namespace spikeserve

#endif  // SERVER_WEB_EMBEDDED_FILES_H_
