# Tests in Python. The tests of the folder tests/python install the client before the first test that needs it.
#
# Each version has its own folder, because pip --target keeps the metadata of older ones.
set(SPIKESERVE_PYTHON_CLIENT ${CMAKE_BINARY_DIR}/tests/python_client-${PROJECT_VERSION})

# spikeserve_python_tests([CLIENT | ENGINE] [LABEL label] [TIMEOUT seconds] [ENVIRONMENT VARIABLE=VALUE...] TESTS path...)
# Runs each path.py with pytest, a path from the current folder; the test has the name of the file. CLIENT: imports the installed client. ENGINE: imports the Python
# engine, too. Every test gets the paths of all programs, as NAME_PROGRAM, and of the folders that setup fills. Trainings use
# one thread, because on a busy machine the threads of a training wait for each other. Those of SPIKESERVE_FULL_TESTS get the
# label full.
function(spikeserve_python_tests)
  cmake_parse_arguments(ARG "CLIENT;ENGINE" "LABEL;TIMEOUT" "ENVIRONMENT;TESTS" ${ARGN})
  set(environment "PYTHONDONTWRITEBYTECODE=1;OMP_NUM_THREADS=1;TEST_TIME=${SPIKESERVE_TEST_TIME}")
  list(APPEND environment SPIKESERVE_BUILD_DIR=${CMAKE_BINARY_DIR} SPIKESERVE_SHARE=${CMAKE_BINARY_DIR}/share
    SPIKESERVE_VERSION=${PROJECT_VERSION} SPIKESERVE_INTEROP=${PROJECT_SOURCE_DIR}/build/interop
    OWN_ENVIRONMENTS=${PROJECT_SOURCE_DIR}/build/environments CHIPS_PYTHON=${PROJECT_SOURCE_DIR}/build/chips/venv/bin/python)
  if(TARGET spiketrain)
    list(APPEND environment SPIKETRAIN=$<TARGET_FILE:spiketrain>)  # what spikeserve.imitation starts
  endif()
  foreach(program spikeserve spikectl spikeload client_player client_pilot example_call readme_call environment_stepper integer_decisions alert_replay chip_stream
      spiketrain spikereport dense_baseline)
    if(TARGET ${program})
      string(TOUPPER ${program} name)
      string(APPEND environment ";${name}_PROGRAM=$<TARGET_FILE:${program}>")
    endif()
  endforeach()
  if(ARG_CLIENT)
    list(APPEND ARG_ENVIRONMENT PYTHONPATH=${SPIKESERVE_PYTHON_CLIENT})
  elseif(ARG_ENGINE)
    list(APPEND ARG_ENVIRONMENT PYTHONPATH=${SPIKESERVE_PYTHON_CLIENT}:${CMAKE_BINARY_DIR}/python)
  endif()
  foreach(path ${ARG_TESTS})
    get_filename_component(name ${path} NAME)
    add_test(NAME ${name}
             COMMAND ${SPIKESERVE_PYTHON} -m pytest -q -rs -p no:cacheprovider ${CMAKE_CURRENT_SOURCE_DIR}/${path}.py)
    set_tests_properties(${name} PROPERTIES LABELS python ENVIRONMENT "${environment};${ARG_ENVIRONMENT}")
    spikeserve_limit_time(600 ${name})
    if(ARG_CLIENT OR ARG_ENGINE)
      set_tests_properties(${name} PROPERTIES FIXTURES_REQUIRED python_client)
    endif()
    if(ARG_LABEL)
      set_tests_properties(${name} PROPERTIES LABELS ${ARG_LABEL})
    endif()
    if(name IN_LIST SPIKESERVE_FULL_TESTS)
      set_property(TEST ${name} APPEND PROPERTY LABELS full)
    endif()
    if(ARG_TIMEOUT)
      set_tests_properties(${name} PROPERTIES TIMEOUT ${ARG_TIMEOUT})
    endif()
  endforeach()
endfunction()
