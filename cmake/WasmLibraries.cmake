# Gives find_package() the libraries of core for WebAssembly (preset wasm). Debian has none of them compiled, so Abseil and
# Highway come as sources, which deploy/wasm_sources.sh unpacks; the build compiles the parts that are used. The others are
# headers of this machine.
set(sources ${CMAKE_CURRENT_SOURCE_DIR}/build/wasm-sources)
if(NOT EXISTS ${sources}/complete)
  message(FATAL_ERROR "${sources}: expected the sources that deploy/wasm_sources.sh unpacks, found none")
endif()

# package(NAME COMMANDS): find_package(NAME) runs these commands.
function(package name commands)
  file(WRITE ${CMAKE_FIND_PACKAGE_REDIRECTS_DIR}/${name}-config.cmake "${commands}")
endfunction()

set(BUILD_TESTING OFF CACHE BOOL "" FORCE)
set(ABSL_PROPAGATE_CXX_STD ON CACHE BOOL "" FORCE)
set(HWY_ENABLE_CONTRIB OFF CACHE BOOL "" FORCE)
set(HWY_ENABLE_EXAMPLES OFF CACHE BOOL "" FORCE)
package(absl "
  set(CMAKE_MESSAGE_LOG_LEVEL ERROR)  # it warns of a processor that it does not know
  add_subdirectory(${sources}/abseil ${CMAKE_BINARY_DIR}/abseil EXCLUDE_FROM_ALL)
  unset(CMAKE_MESSAGE_LOG_LEVEL)")
package(hwy "
  add_subdirectory(${sources}/highway ${CMAKE_BINARY_DIR}/highway EXCLUDE_FROM_ALL)
  add_library(hwy::hwy ALIAS hwy)")
package(eigen3 "
  add_library(Eigen3::Eigen INTERFACE IMPORTED)
  target_include_directories(Eigen3::Eigen INTERFACE /usr/include/eigen3)")
# Its folder is /usr/include, where this machine's C library is, too.
file(MAKE_DIRECTORY ${CMAKE_BINARY_DIR}/headers)
file(CREATE_LINK /usr/include/nlohmann ${CMAKE_BINARY_DIR}/headers/nlohmann SYMBOLIC)
package(nlohmann_json "
  add_library(nlohmann_json::nlohmann_json INTERFACE IMPORTED)
  target_include_directories(nlohmann_json::nlohmann_json INTERFACE ${CMAKE_BINARY_DIR}/headers)")
