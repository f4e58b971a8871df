/* Sizes of the structures that Python mirrors (epigauge/_native.py, epigauge/two_view/native.py). */
#include <string.h>

#include "bundle.h"
#include "two_view.h"

/* Size of a structure by its name; 0 where it is not shared. */
EG_EXPORT ptrdiff_t eg_shared_size(const char *name)
{
    static const struct {
        const char *name;
        size_t size;
    } shared[] = {
        {"eg_bundle", sizeof(eg_bundle)},
        {"eg_envelope", sizeof(eg_envelope)},
        {"eg_blocks", sizeof(eg_blocks)},
        {"eg_refinement", sizeof(eg_refinement)},
        {"eg_bundle_options", sizeof(eg_bundle_options)},
        {"eg_bundle_normal", sizeof(eg_bundle_normal)},
        {"eg_options", sizeof(eg_options)},
        {"eg_outcome", sizeof(eg_outcome)},
        {"eg_mixture_options", sizeof(eg_mixture_options)},
        {"eg_plane_options", sizeof(eg_plane_options)},
        {"eg_quick_options", sizeof(eg_quick_options)},
        {"eg_search_options", sizeof(eg_search_options)},
    };
    for (size_t k = 0; k < sizeof shared / sizeof shared[0]; ++k)
        if (!strcmp(shared[k].name, name))
            return (ptrdiff_t)shared[k].size;
    return 0;
}
