# Defines the target `torch`, which links the libtorch of a PyTorch wheel: SPIKESERVE_TORCH is the folder `torch` that
# `pip install torch` makes.
#
# Does not use the wheel's own TorchConfig.cmake. The wheels of PyPI are built with CUDA, so that file searches for the
# CUDA toolkit, and training needs the processor only.
set(libraries)
foreach(name torch_cpu c10)
  set(library ${SPIKESERVE_TORCH}/lib/lib${name}.so)
  if(NOT EXISTS ${library})
    message(FATAL_ERROR "SPIKESERVE_TORCH: expected the folder torch of a PyTorch wheel, received ${SPIKESERVE_TORCH}, "
                        "which has no lib/lib${name}.so")
  endif()
  list(APPEND libraries ${library})
endforeach()

# Wheels before 2.7 have the C++ ABI of GCC 4, in which std::string is another type than Debian's.
set(version unknown)
if(EXISTS ${SPIKESERVE_TORCH}/version.py)
  file(STRINGS ${SPIKESERVE_TORCH}/version.py line REGEX "^__version__ *= *")
  string(REGEX REPLACE "^[^'\"]*['\"]([0-9.]+).*" "\\1" version "${line}")
endif()
if(NOT version VERSION_GREATER_EQUAL 2.7)
  message(FATAL_ERROR "SPIKESERVE_TORCH: expected PyTorch 2.7 or later, received ${version} in ${SPIKESERVE_TORCH}")
endif()
message(STATUS "Training links PyTorch ${version} of ${SPIKESERVE_TORCH}")

add_library(torch INTERFACE IMPORTED GLOBAL)
target_include_directories(torch INTERFACE
  ${SPIKESERVE_TORCH}/include ${SPIKESERVE_TORCH}/include/torch/csrc/api/include)
target_link_libraries(torch INTERFACE ${libraries})
# Installed programs find the libraries where they are now.
set(CMAKE_INSTALL_RPATH_USE_LINK_PATH ON)
