# Writes the commit of the source tree to a C++ file: cmake -DSOURCE_DIR=DIR -DOUTPUT=FILE -P WriteCommit.cmake
#
# Runs at every build and replaces the file only if the commit has changed. The commit is "unknown" outside of a git
# checkout, and ends in "-dirty" if tracked files differ from it.
execute_process(COMMAND git -C ${SOURCE_DIR} rev-parse HEAD
  OUTPUT_VARIABLE commit OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET RESULT_VARIABLE failed)
if(failed)
  set(commit unknown)
else()
  execute_process(COMMAND git -C ${SOURCE_DIR} status --porcelain --untracked-files=no
    OUTPUT_VARIABLE changes OUTPUT_STRIP_TRAILING_WHITESPACE ERROR_QUIET)
  if(changes)
    string(APPEND commit "-dirty")
  endif()
endif()
file(CONFIGURE OUTPUT ${OUTPUT} @ONLY CONTENT [[
#include "train/evaluation/training_record.h"

namespace spikeserve {

std::string BuildCommit() { return "@commit@"; }

}  // namespace spikeserve
]])
