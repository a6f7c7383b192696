# The compiler settings every target shares, and one helper each for a library, a program and a test.

set(CMAKE_CXX_STANDARD 20)
set(CMAKE_CXX_STANDARD_REQUIRED ON)
set(CMAKE_CXX_EXTENSIONS OFF)
set(CMAKE_EXPORT_COMPILE_COMMANDS ON)
set(CMAKE_RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/bin)

add_library(spikeserve_options INTERFACE)
target_include_directories(spikeserve_options INTERFACE ${PROJECT_SOURCE_DIR})
# Spikes must be equal bit for bit on every machine, so a*b+c is never fused behind our back.
target_compile_options(spikeserve_options INTERFACE -Wall -Wextra -Wshadow -Werror -ffp-contract=off)
if(CMAKE_CXX_COMPILER_ID STREQUAL "Clang")
  target_compile_options(spikeserve_options INTERFACE -Wthread-safety)
endif()

# The thread sanitizer needs to be told what libraries that were built without it order.
option(SPIKESERVE_TSAN "Programs run under the thread sanitizer" OFF)
if(SPIKESERVE_TSAN)
  set(SPIKESERVE_PROGRAM_SOURCES
    ${PROJECT_SOURCE_DIR}/tests/sanitizers/tsan_absl.cc ${PROJECT_SOURCE_DIR}/tests/sanitizers/tsan_grpc.cc)
endif()

# spikeserve_library(NAME SOURCES file... [DEPENDS target...] [PRIVATE_DEPENDS target...])
# DEPENDS are what the headers of the library include, PRIVATE_DEPENDS what only its sources do.
function(spikeserve_library name)
  cmake_parse_arguments(ARG "" "" "SOURCES;DEPENDS;PRIVATE_DEPENDS" ${ARGN})
  add_library(${name} STATIC ${ARG_SOURCES})
  target_link_libraries(${name} PUBLIC spikeserve_options ${ARG_DEPENDS} PRIVATE ${ARG_PRIVATE_DEPENDS})
endfunction()

# spikeserve_program(NAME SOURCES file... [DEPENDS target...]): lands in <build>/bin.
function(spikeserve_program name)
  cmake_parse_arguments(ARG "" "" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${name} ${ARG_SOURCES} ${SPIKESERVE_PROGRAM_SOURCES})
  target_link_libraries(${name} PRIVATE spikeserve_options ${ARG_DEPENDS})
endfunction()

# spikeserve_test(NAME LABEL unit|parity|integration|slow SOURCES file... [DEPENDS target...])
function(spikeserve_test name)
  cmake_parse_arguments(ARG "" "LABEL" "SOURCES;DEPENDS" ${ARGN})
  add_executable(${name} ${ARG_SOURCES} ${SPIKESERVE_PROGRAM_SOURCES})
  set_target_properties(${name} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  target_link_libraries(${name} PRIVATE spikeserve_options ${ARG_DEPENDS} GTest::gmock_main)
  add_test(NAME ${name} COMMAND ${name})
  set_tests_properties(${name} PROPERTIES LABELS "${ARG_LABEL}" TIMEOUT 600)
endfunction()
