# lodestone_room(<name> SOURCES ... SEES ...): one static library, the rules of the house applied. SEES is the whole
# dependency list.
function(lodestone_flags target)
  target_compile_options(${target} PRIVATE -Wall -Wextra -Wpedantic -Wno-missing-field-initializers)
  # Heights must be the same bits on every machine: no fused multiply-add that the source does not ask for.
  target_compile_options(${target} PRIVATE -ffp-contract=off)
  target_include_directories(${target} PUBLIC ${PROJECT_SOURCE_DIR})
endfunction()

function(lodestone_room name)
  cmake_parse_arguments(ROOM "" "" "SOURCES;SEES" ${ARGN})
  add_library(lodestone_${name} STATIC ${ROOM_SOURCES})
  lodestone_flags(lodestone_${name})
  target_link_libraries(lodestone_${name} PUBLIC ${ROOM_SEES})
endfunction()

# lodestone_embed(<out.cpp> <symbol> <files...>): text files as string literals in a C++ source,
# `const EmbeddedFile symbol[]; const std::size_t symbol_count;` (cmake/embed.h).
function(lodestone_embed out symbol)
  add_custom_command(OUTPUT ${out}
    COMMAND ${CMAKE_COMMAND} -DOUT=${out} -DSYMBOL=${symbol} "-DFILES=${ARGN}" -DROOT=${PROJECT_SOURCE_DIR}
            -P ${PROJECT_SOURCE_DIR}/cmake/embed.cmake
    DEPENDS ${ARGN} ${PROJECT_SOURCE_DIR}/cmake/embed.cmake
    COMMENT "Embedding ${symbol}" VERBATIM)
endfunction()
