# Compiles files into a program.
#
# spikeserve_embed(TARGET HEADER header FUNCTION name BASE folder FILES file...): adds the library TARGET, a generated source that
# defines spikeserve::name(), which `header` declares, with the contents of the files, by their path below BASE.
# The build runs this file as a script (cmake -P), which writes that source when one of the files has changed.
if(CMAKE_SCRIPT_MODE_FILE)
  set(arrays "")
  set(entries "")
  list(LENGTH FILES count)
  math(EXPR last "${count} - 1")
  foreach(i RANGE ${last})
    list(GET FILES ${i} file)
    file(READ ${BASE}/${file} bytes HEX)
    string(REGEX REPLACE "(..)" "0x\\1," bytes "${bytes}")
    string(APPEND arrays "constexpr unsigned char kFile${i}[] = {${bytes}};\n")
    string(APPEND entries "    {\"${file}\", View(kFile${i})},\n")
  endforeach()
  file(WRITE ${OUTPUT} "#include \"${HEADER}\"

namespace spikeserve {
namespace {

template <size_t n>
absl::string_view View(const unsigned char (&bytes)[n]) {
  return {reinterpret_cast<const char*>(bytes), n};
}

${arrays}
}  // namespace

const std::map<absl::string_view, absl::string_view>& ${FUNCTION}() {
  static const auto* const files = new std::map<absl::string_view, absl::string_view>{
${entries}  };
  return *files;
}

}  // namespace spikeserve
")
  return()
endif()

function(spikeserve_embed target)
  cmake_parse_arguments(ARG "" "BASE;FUNCTION;HEADER" "FILES" ${ARGN})
  set(output ${CMAKE_CURRENT_BINARY_DIR}/embedded_files.cc)
  list(TRANSFORM ARG_FILES PREPEND ${ARG_BASE}/ OUTPUT_VARIABLE paths)
  set(script ${PROJECT_SOURCE_DIR}/cmake/EmbedFiles.cmake)
  add_custom_command(
    OUTPUT ${output}
    COMMAND ${CMAKE_COMMAND} -D "FILES=${ARG_FILES}" -D BASE=${ARG_BASE} -D HEADER=${ARG_HEADER}
            -D FUNCTION=${ARG_FUNCTION} -D OUTPUT=${output} -P ${script}
    DEPENDS ${paths} ${script}
    VERBATIM)
  add_library(${target} STATIC ${output})
  target_link_libraries(${target} PRIVATE spikeserve_options PUBLIC absl::strings)
endfunction()
