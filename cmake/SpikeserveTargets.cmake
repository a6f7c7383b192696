# Defines the compiler settings of all targets, and one helper each for a library, a program and a test.

set(CMAKE_CXX_STANDARD 20)
set(CMAKE_CXX_STANDARD_REQUIRED ON)
set(CMAKE_CXX_EXTENSIONS OFF)
set(CMAKE_EXPORT_COMPILE_COMMANDS ON)
set(CMAKE_RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/bin)

add_library(spikeserve_options INTERFACE)
target_include_directories(spikeserve_options INTERFACE ${PROJECT_SOURCE_DIR})
# -ffp-contract=off: the compiler must not fuse a*b+c, because spikes must be equal bit for bit on every machine.
target_compile_options(spikeserve_options INTERFACE -Wall -Wextra -Wshadow -Werror -ffp-contract=off)
if(CMAKE_CXX_COMPILER_ID STREQUAL "Clang")
  target_compile_options(spikeserve_options INTERFACE -Wthread-safety)
endif()
if(EMSCRIPTEN)
  target_compile_options(spikeserve_options INTERFACE -include ${PROJECT_SOURCE_DIR}/cmake/toolchains/wasm_std.h)
endif()

# Abseil and gRPC are built without the thread sanitizer. The sources below tell it how they synchronise threads.
option(SPIKESERVE_TSAN "Build programs for the thread sanitizer" OFF)
if(SPIKESERVE_TSAN)
  set(SPIKESERVE_PROGRAM_SOURCES
    ${PROJECT_SOURCE_DIR}/tests/sanitizers/tsan_absl.cc ${PROJECT_SOURCE_DIR}/tests/sanitizers/tsan_grpc.cc)
endif()

# spikeserve_optimize(LEVEL): compiles the current folder with LEVEL instead of -O3, a release's default, which core/math,
# the spiking engine and all that names no level keep. What carries an Act has -O2. Command lines, the HTTP port and
# generated messages have -O1: the messages compile in two thirds of the time, and an Act takes as many instructions.
macro(spikeserve_optimize level)
  string(REGEX REPLACE "-O[23]" ${level} CMAKE_CXX_FLAGS_RELEASE "${CMAKE_CXX_FLAGS_RELEASE}")
endmacro()

# Most of the time of a source goes into headers. A unit compiles them once for many sources: a quarter of the processor time for
# everything, but more after a change of one source.
option(SPIKESERVE_UNITY "Compile many sources at once: a library, a program, or the components of an archive" ON)

# Writes units that include the sources `ARGN`, up to 32 each, and returns in the variable `out` what is to be compiled instead. The paths
# in a unit are relative to the project, so that clones in different folders share the compiler cache. A source with its full path
# stays alone, and a single one is no unit.
function(spikeserve_units out name)
  set(generated ${ARGN})
  list(FILTER generated INCLUDE REGEX "^/")
  set(sources ${ARGN})
  list(FILTER sources EXCLUDE REGEX "^/")
  list(LENGTH sources count)
  if(count LESS 2 OR NOT SPIKESERVE_UNITY)
    set(${out} ${ARGN} PARENT_SCOPE)
    return()
  endif()
  set(compiled ${generated})
  set(number 0)
  foreach(source ${sources})
    math(EXPR unit "${number} / 32")
    math(EXPR number "${number} + 1")
    spikeserve_include(line ${source})
    string(APPEND text_${unit} ${line})
  endforeach()
  foreach(i RANGE ${unit})
    set(path ${CMAKE_CURRENT_BINARY_DIR}/${name}_unit_${i}.cc)
    file(CONFIGURE OUTPUT ${path} CONTENT "${text_${i}}" @ONLY)
    list(APPEND compiled ${path})
  endforeach()
  spikeserve_unit_options(${compiled})
  set(${out} ${compiled} PARENT_SCOPE)
endfunction()

# Returns the line with which a unit includes a source of the current folder.
function(spikeserve_include out source)
  file(RELATIVE_PATH folder ${PROJECT_SOURCE_DIR} ${CMAKE_CURRENT_SOURCE_DIR})
  set(${out} "#include \"${folder}/${source}\"\n" PARENT_SCOPE)
endfunction()

# In a unit, a type of an anonymous namespace is not in the main file, but in no header either.
function(spikeserve_unit_options)
  set_source_files_properties(${ARGN} PROPERTIES COMPILE_OPTIONS $<$<CXX_COMPILER_ID:GNU>:-Wno-subobject-linkage>)
endfunction()

# spikeserve_library(NAME [ARCHIVE archive] SOURCES file... [SEPARATE file...] [DEPENDS target...] [PRIVATE_DEPENDS target...])
# Adds a static library. SEPARATE are sources that are compiled alone, because they have options of their own. DEPENDS are
# the libraries whose headers its headers include, PRIVATE_DEPENDS those that only its sources include. Each folder of the
# tree is one library; tests/check_layers.py checks its includes against this list.
#
# ARCHIVE: components that name the same archive, one after the other, are compiled as one unit, because most of the headers
# that they include are the same. What such a component has of its own beside sources, it adds to the target that
# spikeserve_compiled_in() returns.
function(spikeserve_library name)
  cmake_parse_arguments(ARG "" "ARCHIVE" "SOURCES;SEPARATE;DEPENDS;PRIVATE_DEPENDS" ${ARGN})
  if(ARG_ARCHIVE AND SPIKESERVE_UNITY)
    spikeserve_archive(${ARG_ARCHIVE} ${name} "${ARG_SOURCES}" "${ARG_DEPENDS}" "${ARG_PRIVATE_DEPENDS}")
  else()
    spikeserve_units(units ${name} ${ARG_SOURCES})
    add_library(${name} STATIC ${units} ${ARG_SEPARATE})
    target_link_libraries(${name}
      PUBLIC $<BUILD_INTERFACE:spikeserve_options> ${ARG_DEPENDS} PRIVATE ${ARG_PRIVATE_DEPENDS})
    set_property(GLOBAL APPEND PROPERTY SPIKESERVE_LIBRARIES ${name})
  endif()
  set(all ${ARG_SOURCES} ${ARG_SEPARATE})
  spikeserve_note_layer(${name} "${all}" "${ARG_DEPENDS}" "${ARG_PRIVATE_DEPENDS}")
endfunction()

# Adds the component `name` to a static library of several components, and a target `name` that links that library.
function(spikeserve_archive archive name sources public private)
  if(NOT TARGET ${archive})
    set(unit ${CMAKE_CURRENT_BINARY_DIR}/${archive}_unit_0.cc)
    file(GENERATE OUTPUT ${unit} CONTENT "$<JOIN:$<TARGET_PROPERTY:${archive},SPIKESERVE_INCLUDES>,>")
    spikeserve_unit_options(${unit})
    add_library(${archive} STATIC ${unit})
    target_link_libraries(${archive} PUBLIC $<BUILD_INTERFACE:spikeserve_options>)
    set_property(GLOBAL APPEND PROPERTY SPIKESERVE_LIBRARIES ${archive})
  endif()
  foreach(source ${sources})
    spikeserve_include(line ${source})
    set_property(TARGET ${archive} APPEND PROPERTY SPIKESERVE_INCLUDES ${line})
  endforeach()
  get_target_property(inside ${archive} SPIKESERVE_COMPONENTS)
  foreach(list public private)
    if(inside AND ${list})
      list(REMOVE_ITEM ${list} ${inside})
    endif()
  endforeach()
  target_link_libraries(${archive} PUBLIC ${public} PRIVATE ${private})
  set_property(TARGET ${archive} APPEND PROPERTY SPIKESERVE_COMPONENTS ${name})
  add_library(${name} INTERFACE)
  target_link_libraries(${name} INTERFACE ${archive})
  set_target_properties(${name} PROPERTIES SPIKESERVE_ARCHIVE ${archive})
endfunction()

# Returns the target that compiles the sources of a component: its archive, or itself.
function(spikeserve_compiled_in out component)
  get_target_property(archive ${component} SPIKESERVE_ARCHIVE)
  if(NOT archive)
    set(archive ${component})
  endif()
  set(${out} ${archive} PARENT_SCOPE)
endfunction()

# Appends a library or a program to the list that spikeserve_check_layers() writes.
function(spikeserve_note_layer name sources public private)
  file(RELATIVE_PATH folder ${PROJECT_SOURCE_DIR} ${CMAKE_CURRENT_SOURCE_DIR})
  set(entry "\"name\": \"${name}\", \"folder\": \"${folder}\"")
  foreach(list sources public private)
    list(TRANSFORM ${list} REPLACE "(.+)" "\"\\1\"")
    list(JOIN ${list} ", " ${list})
    string(APPEND entry ", \"${list}\": [${${list}}]")
  endforeach()
  set_property(GLOBAL APPEND PROPERTY SPIKESERVE_LAYERS "{${entry}}")
endfunction()

# spikeserve_program(NAME SOURCES file... [DEPENDS target...]): adds a program, built in <build>/bin.
function(spikeserve_program name)
  cmake_parse_arguments(ARG "" "" "SOURCES;DEPENDS" ${ARGN})
  spikeserve_units(units ${name} ${ARG_SOURCES})
  add_executable(${name} ${units} ${SPIKESERVE_PROGRAM_SOURCES})
  target_link_libraries(${name} PRIVATE spikeserve_options ${ARG_DEPENDS})
  spikeserve_note_layer(${name} "${ARG_SOURCES}" "" "${ARG_DEPENDS}")
endfunction()

set(SPIKESERVE_TEST_TIME 1 CACHE STRING "How many times as long as usual a test may take, for emulated processors")

# spikeserve_limit_time(SECONDS TEST...): sets the time after which ctest ends tests of the current folder.
function(spikeserve_limit_time seconds)
  math(EXPR limit "${seconds} * ${SPIKESERVE_TEST_TIME}")
  set_tests_properties(${ARGN} PROPERTIES TIMEOUT ${limit})
endfunction()

add_custom_target(cpp_tests)  # the unit tests in C++, and the programs that tests with the label integration start

# spikeserve_test_program(NAME SOURCES file... [DEPENDS target...]): adds a program that tests start, built in <build>/tests.
function(spikeserve_test_program name)
  cmake_parse_arguments(ARG "" "" "SOURCES;DEPENDS" ${ARGN})
  spikeserve_units(units ${name} ${ARG_SOURCES})
  add_executable(${name} ${units} ${SPIKESERVE_PROGRAM_SOURCES})
  set_target_properties(${name} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests)
  target_link_libraries(${name} PRIVATE spikeserve_options ${ARG_DEPENDS})
endfunction()

# spikeserve_test(NAME LABEL unit|parity|slow SOURCES file... [DEPENDS target...]): adds a GoogleTest program and a ctest
# test that runs it whole: a process for each TEST takes longer than most TESTs.
function(spikeserve_test name)
  cmake_parse_arguments(ARG "" "LABEL" "SOURCES;DEPENDS" ${ARGN})
  spikeserve_test_program(${name} SOURCES ${ARG_SOURCES} DEPENDS ${ARG_DEPENDS} spikeserve_test_main)
  if(ARG_LABEL STREQUAL "unit")
    add_dependencies(cpp_tests ${name})
  endif()
  # One thread: those of two programs that compute at once wait for each other in spin loops, many times as long as the work.
  add_test(NAME ${name} COMMAND ${name} --gtest_brief=1)
  set_tests_properties(${name} PROPERTIES LABELS ${ARG_LABEL} ENVIRONMENT OMP_NUM_THREADS=1)
  spikeserve_limit_time(1800 ${name})
  if(ARG_LABEL STREQUAL "slow")
    spikeserve_limit_time(7200 ${name})
  endif()
endfunction()

# Links each library, or archive of components, into a program with only the dependencies that its CMakeLists.txt names, so
# that a missing one fails the build. Writes layers.json for tests/check_layers.py. Call it after the last library.
function(spikeserve_check_layers)
  get_property(layers GLOBAL PROPERTY SPIKESERVE_LAYERS)
  list(JOIN layers ",\n" layers)
  file(WRITE ${CMAKE_BINARY_DIR}/layers.json "[${layers}]\n")
  file(GENERATE OUTPUT ${CMAKE_BINARY_DIR}/link_check.cc CONTENT "int main() {}\n")
  get_property(libraries GLOBAL PROPERTY SPIKESERVE_LIBRARIES)
  foreach(library ${libraries})
    add_executable(link_${library} ${CMAKE_BINARY_DIR}/link_check.cc)
    set_target_properties(link_${library} PROPERTIES RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/tests/links)
    target_link_libraries(link_${library} PRIVATE $<LINK_LIBRARY:WHOLE_ARCHIVE,${library}>)
  endforeach()
endfunction()
