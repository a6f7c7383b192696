# Defines what `cmake --install` installs, and the Debian packages that `cpack` makes from it. Each program is installed
# with its manual page and its completion scripts for bash, zsh and fish.
#
# | component | Debian package          | content                                                          |
# | server    | spikeserve              | spikeserve, its systemd unit and user, the shipped policies      |
# | client    | libspikeserve-dev       | the C++ client: headers, static libraries, CMake package, .pc    |
# | robot     | libspikeserve-robot0    | libspikeserve_robot.so.0, the robot's end for C                  |
# | robot_dev | libspikeserve-robot-dev | its header, its link and its .pc                                 |
# | tools     | spikeserve-tools        | spikectl and spikeload                                           |
# | train     | spikeserve-train        | spiketrain                                                       |
include(GNUInstallDirs)
include(CMakePackageConfigHelpers)

install(TARGETS spikeserve RUNTIME COMPONENT server)
install(DIRECTORY deploy/policies DESTINATION ${CMAKE_INSTALL_DATADIR}/spikeserve COMPONENT server)
install(TARGETS spikectl spikeload RUNTIME COMPONENT tools)
spikeserve_install_texts(server spikeserve)
spikeserve_install_texts(tools spikectl spikeload)
set(components server client robot robot_dev tools)
if(SPIKESERVE_BUILD_TRAIN)
  install(TARGETS spiketrain RUNTIME COMPONENT train)
  spikeserve_install_texts(train spiketrain)
  list(APPEND components train)
endif()

# The unit contains the installation prefix, which is known only at installation.
install(CODE "
  set(SPIKESERVE_BINDIR \${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_BINDIR})
  set(SPIKESERVE_DATADIR \${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_DATADIR}/spikeserve)
  configure_file(${PROJECT_SOURCE_DIR}/deploy/systemd/spikeserve.service.in
                 ${CMAKE_BINARY_DIR}/spikeserve.service @ONLY)
  file(INSTALL ${CMAKE_BINARY_DIR}/spikeserve.service
       DESTINATION \${CMAKE_INSTALL_PREFIX}/lib/systemd/system)"
  COMPONENT server)

# The C++ client.
set_target_properties(spikeserve_client PROPERTIES EXPORT_NAME client)
set_target_properties(spikeserve_datagram PROPERTIES EXPORT_NAME datagram)
set_target_properties(spikeserve_proto PROPERTIES EXPORT_NAME proto)
set_target_properties(spikeserve_stubs PROPERTIES EXPORT_NAME stubs)
# Not libspikeserve_robot, which is the shared library for C.
set_target_properties(spikeserve_robot PROPERTIES EXPORT_NAME robot OUTPUT_NAME spikeserve_robot_session)
install(TARGETS spikeserve_client spikeserve_datagram spikeserve_robot spikeserve_stubs spikeserve_proto EXPORT spikeserveTargets
  ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT client
  INCLUDES DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})

# The engine on a robot, one archive of the components that it links, so that none of them is a library of the package.
set(objects)
foreach(component action agent base contract dataset dense_engine digest engine engine_factory journal learning local_engine math model reference_engine session
    spiking_engine)
  spikeserve_compiled_in(compiled spikeserve_${component})
  list(APPEND objects $<TARGET_OBJECTS:${compiled}>)
endforeach()
list(REMOVE_DUPLICATES objects)
add_library(spikeserve_installed_engine STATIC ${objects})
target_link_libraries(spikeserve_installed_engine PUBLIC spikeserve_client
  absl::core_headers absl::flat_hash_map absl::function_ref absl::inlined_vector absl::span absl::status absl::statusor
  absl::str_format absl::strings absl::synchronization absl::time hwy::hwy OpenSSL::Crypto Threads::Threads)
set_target_properties(spikeserve_installed_engine PROPERTIES
  LINKER_LANGUAGE CXX OUTPUT_NAME spikeserve_local_engine EXPORT_NAME local_engine)
install(TARGETS spikeserve_installed_engine EXPORT spikeserveEngineTargets
  ARCHIVE DESTINATION ${CMAKE_INSTALL_LIBDIR} COMPONENT client
  INCLUDES DESTINATION ${CMAKE_INSTALL_INCLUDEDIR})

install(DIRECTORY client/include/spikeserve client/engine/include/spikeserve DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT client)
install(DIRECTORY ${CMAKE_BINARY_DIR}/proto/spikeserve DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT client
  FILES_MATCHING PATTERN "*.pb.h")
set(package_dir ${CMAKE_INSTALL_LIBDIR}/cmake/spikeserve)
install(EXPORT spikeserveTargets NAMESPACE spikeserve:: DESTINATION ${package_dir} COMPONENT client)
install(EXPORT spikeserveEngineTargets NAMESPACE spikeserve:: DESTINATION ${package_dir} COMPONENT client)
configure_package_config_file(cmake/package/spikeserveConfig.cmake.in ${CMAKE_BINARY_DIR}/spikeserveConfig.cmake
  INSTALL_DESTINATION ${package_dir})
write_basic_package_version_file(${CMAKE_BINARY_DIR}/spikeserveConfigVersion.cmake COMPATIBILITY SameMinorVersion)
install(FILES ${CMAKE_BINARY_DIR}/spikeserveConfig.cmake ${CMAKE_BINARY_DIR}/spikeserveConfigVersion.cmake
  DESTINATION ${package_dir} COMPONENT client)
file(RELATIVE_PATH SPIKESERVE_PC_PREFIX /${CMAKE_INSTALL_LIBDIR}/pkgconfig /)
configure_file(cmake/package/spikeserve.pc.in ${CMAKE_BINARY_DIR}/spikeserve.pc @ONLY)
install(FILES ${CMAKE_BINARY_DIR}/spikeserve.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig COMPONENT client)

# The robot's end for C.
install(TARGETS spikeserve_c_robot LIBRARY COMPONENT robot NAMELINK_COMPONENT robot_dev)
install(FILES client/c/spikeserve_robot.h DESTINATION ${CMAKE_INSTALL_INCLUDEDIR} COMPONENT robot_dev)
configure_file(cmake/package/spikeserve_robot.pc.in ${CMAKE_BINARY_DIR}/spikeserve_robot.pc @ONLY)
install(FILES ${CMAKE_BINARY_DIR}/spikeserve_robot.pc DESTINATION ${CMAKE_INSTALL_LIBDIR}/pkgconfig COMPONENT robot_dev)

# Installs Debian's changelog of a package, compressed. Its time is that of the packages, SOURCE_DATE_EPOCH if it is set.
function(spikeserve_install_changelog component package)
  install(CODE "
    set(package ${package})
    set(version ${PROJECT_VERSION})
    string(TIMESTAMP date \"%a, %d %b %Y %H:%M:%S +0000\" UTC)
    set(changelog ${CMAKE_BINARY_DIR}/debian/${package}/changelog)
    configure_file(${PROJECT_SOURCE_DIR}/deploy/debian/changelog.in \${changelog} @ONLY)
    execute_process(COMMAND gzip -9nf \${changelog} COMMAND_ERROR_IS_FATAL ANY)
    file(INSTALL \${changelog}.gz
         DESTINATION \${CMAKE_INSTALL_PREFIX}/${CMAKE_INSTALL_DATADIR}/doc/${package})"
    COMPONENT ${component})
endfunction()

set(package_server spikeserve)
set(package_client libspikeserve-dev)
set(package_robot libspikeserve-robot0)
set(package_robot_dev libspikeserve-robot-dev)
set(package_tools spikeserve-tools)
set(package_train spikeserve-train)
foreach(component ${components})
  string(TOUPPER ${component} upper)
  spikeserve_install_changelog(${component} ${package_${component}})
  install(FILES LICENSE NOTICE deploy/debian/copyright DESTINATION ${CMAKE_INSTALL_DATADIR}/doc/${package_${component}} COMPONENT ${component})
  set(CPACK_DEBIAN_${upper}_PACKAGE_NAME ${package_${component}})
endforeach()

set(CPACK_GENERATOR DEB)
set(CPACK_PACKAGE_NAME spikeserve)
set(CPACK_PACKAGE_CONTACT "spikeserve maintainers <maintainers@spikeserve.invalid>")
set(CPACK_PACKAGE_DIRECTORY ${CMAKE_BINARY_DIR}/packages)
set(CPACK_PACKAGING_INSTALL_PREFIX /usr)
set(CPACK_STRIP_FILES ON)
set(CPACK_COMPONENTS_ALL ${components})
set(CPACK_DEB_COMPONENT_INSTALL ON)
set(CPACK_DEBIAN_FILE_NAME DEB-DEFAULT)
set(CPACK_DEBIAN_PACKAGE_SHLIBDEPS ON)
set(CPACK_DEBIAN_PACKAGE_SECTION net)
set(CPACK_COMPONENT_SERVER_DESCRIPTION "inference service for Spiking Decision Transformers
Answers the observations of robots and simulators with actions, over gRPC.
It keeps a session for each agent, in files or in Redis, and serves the
policies in /usr/share/spikeserve/policies.")
set(CPACK_COMPONENT_CLIENT_DESCRIPTION "C++ client library of spikeserve
Contains headers, static libraries, a CMake package and a file for pkg-config.
The engine on a robot also needs libhwy-dev.")
set(CPACK_COMPONENT_ROBOT_DESCRIPTION "robot's end of a session of spikeserve
Gives each control step of a robot an action in time, whatever its link to the
server does.")
set(CPACK_COMPONENT_ROBOT_DEV_DESCRIPTION "robot's end of a session of spikeserve, for C
Contains the header and a file for pkg-config.")
set(CPACK_COMPONENT_TOOLS_DESCRIPTION "command-line client and load generator of spikeserve
The program spikectl plays, watches and administers policies of a server. The
program spikeload measures a server under the load of many sessions.")
set(CPACK_COMPONENT_TRAIN_DESCRIPTION "trainer of policies for spikeserve
The program spiketrain makes datasets, trains Spiking Decision Transformers on
them, and evaluates policies.")
set(CPACK_DEBIAN_CLIENT_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_CLIENT_PACKAGE_DEPENDS "libgrpc++-dev, libprotobuf-dev, libabsl-dev, libssl-dev")
set(CPACK_DEBIAN_CLIENT_PACKAGE_RECOMMENDS "libhwy-dev")
set(CPACK_DEBIAN_PACKAGE_GENERATE_SHLIBS ON)
set(CPACK_DEBIAN_PACKAGE_GENERATE_SHLIBS_POLICY ">=")
set(CPACK_DEBIAN_ROBOT_PACKAGE_SECTION libs)
set(CPACK_DEBIAN_ROBOT_PACKAGE_CONTROL_EXTRA ${PROJECT_SOURCE_DIR}/deploy/debian/triggers)
set(CPACK_DEBIAN_ROBOT_DEV_PACKAGE_SECTION libdevel)
set(CPACK_DEBIAN_ROBOT_DEV_PACKAGE_DEPENDS "libspikeserve-robot0 (= ${PROJECT_VERSION})")
set(CPACK_DEBIAN_SERVER_PACKAGE_DEPENDS adduser)
set(CPACK_DEBIAN_SERVER_PACKAGE_CONTROL_EXTRA
  ${PROJECT_SOURCE_DIR}/deploy/debian/postinst ${PROJECT_SOURCE_DIR}/deploy/debian/prerm
  ${PROJECT_SOURCE_DIR}/deploy/debian/postrm)
set(CPACK_DEBIAN_SERVER_PACKAGE_CONTROL_STRICT_PERMISSION ON)
# Cross-built packages: CPack would name them after this machine, and look for the libraries' packages in its data.
if(CMAKE_CROSSCOMPILING)
  set(CPACK_DEBIAN_PACKAGE_ARCHITECTURE ${SPIKESERVE_DEBIAN_ARCHITECTURE})
  configure_file(cmake/package/shlibdeps.sh.in ${CMAKE_BINARY_DIR}/shlibdeps.sh @ONLY)
  file(WRITE ${CMAKE_BINARY_DIR}/CPackCross.cmake "set(SHLIBDEPS_EXECUTABLE ${CMAKE_BINARY_DIR}/shlibdeps.sh)\n")
  set(CPACK_PROJECT_CONFIG_FILE ${CMAKE_BINARY_DIR}/CPackCross.cmake)
endif()
include(CPack)
