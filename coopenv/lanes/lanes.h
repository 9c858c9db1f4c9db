// Numbers of WIDTH neighbouring worlds side by side, and the functions of Warp on them.
//
// `Lanes<T>` has a number of each world, `Mask` a truth value of each. Warp's own templates of vectors and matrices do the
// algebra (`vec_t<3, Lanes<float>>`). A `World` is the first of the worlds, a `Place` the same element of the array of each,
// `Places` any element for each. Inserted behind Warp's headers by `coopenv.lanes`; the functions follow Warp's
// `native/builtin.h`, sine, cosine and logarithm are polynomials with a relative error below 2e-7.
#pragma clang diagnostic ignored "-Wpsabi"  // no vector leaves the module
namespace wp {
#pragma clang fp contract(fast)  // clang fuses no multiplication with an addition through the operators of a struct otherwise
constexpr int WIDTH = 8;
template <bool> struct OnlyIf { };
template <> struct OnlyIf<true> { typedef void type; };
template <class T> struct VectorOf { typedef T type __attribute__((ext_vector_type(WIDTH))); };
template <class T> using Vector = typename VectorOf<T>::type;
template <class To, class From> static inline Vector<To> converted(From x) { return __builtin_convertvector(x, Vector<To>); }

struct Mask {
    Vector<int> v;  // -1: true, 0: false
    Mask() = default;
    Mask(Vector<int> x) : v(x) { }
    Mask(bool x) : v(Vector<int>(x ? -1 : 0)) { }
    friend Mask operator&(Mask a, Mask b) { return a.v & b.v; }
    friend Mask operator|(Mask a, Mask b) { return a.v | b.v; }
    friend Mask operator~(Mask a) { return ~a.v; }
    friend Mask operator==(Mask a, Mask b) { return ~(a.v ^ b.v); }
    friend Mask operator!=(Mask a, Mask b) { return a.v ^ b.v; }
};
static inline Mask unot(Mask a) { return ~a; }
static inline bool any(Mask a) { return __builtin_reduce_or(a.v) != 0; }
static inline bool all(Mask a) { return __builtin_reduce_and(a.v) != 0; }

template <class T> struct Lanes {
    Vector<T> v;
    Lanes() = default;  // trivial: Warp's vectors and matrices start at zero thereby
    Lanes(Vector<T> x) : v(x) { }
    template <class S, class = typename OnlyIf<__is_arithmetic(S)>::type> Lanes(S x) : v(Vector<T>(T(x))) { }
    template <class S> explicit Lanes(Lanes<S> x) : v(converted<T>(x.v)) { }
    explicit Lanes(Mask x) : v(converted<T>(x.v & 1)) { }
#define OPERATOR(OP)                                                                                                       \
    friend Lanes operator OP(Lanes a, Lanes b) { return a.v OP b.v; }                                                      \
    friend Lanes& operator OP##=(Lanes& a, Lanes b) { a.v = a.v OP b.v; return a; }
    OPERATOR(+) OPERATOR(-) OPERATOR(*) OPERATOR(/)
#undef OPERATOR
    friend Lanes operator-(Lanes a) { return -a.v; }
#define COMPARISON(OP) friend Mask operator OP(Lanes a, Lanes b) { return converted<int>(a.v OP b.v); }
    COMPARISON(<) COMPARISON(>) COMPARISON(<=) COMPARISON(>=) COMPARISON(==) COMPARISON(!=)
#undef COMPARISON
};

// A value is a number, or Warp's vector or matrix of numbers: their type, and types of the value in lanes and in one lane.
template <class X> struct Value { typedef X number; typedef Lanes<X> lanes; };
template <> struct Value<bool> { typedef bool number; typedef Mask lanes; };
template <> struct Value<uint8> { typedef uint8 number; typedef Lanes<int> lanes; };
template <class T> struct Value<Lanes<T>> { typedef Lanes<T> number; typedef T lane; };
template <> struct Value<Mask> { typedef Mask number; typedef bool lane; };
template <unsigned N, class T> struct Value<vec_t<N, T>> { typedef T number; typedef vec_t<N, Lanes<T>> lanes; };
template <unsigned N, class T> struct Value<vec_t<N, Lanes<T>>> { typedef Lanes<T> number; typedef vec_t<N, T> lane; };
template <unsigned N, unsigned M, class T> struct Value<mat_t<N, M, T>> { typedef T number; typedef mat_t<N, M, Lanes<T>> lanes; };
template <unsigned N, unsigned M, class T> struct Value<mat_t<N, M, Lanes<T>>> { typedef Lanes<T> number; typedef mat_t<N, M, T> lane; };
template <class X> using Number = typename Value<X>::number;
template <class X> using lanes = typename Value<X>::lanes;
template <class X> constexpr int SIZE = sizeof(X) / sizeof(Number<X>);
template <class X> static inline Number<X>& part(X& x, int n) { return ((Number<X>*)&x)[n]; }
template <class X> static inline const Number<X>& part(const X& x, int n) { return ((const Number<X>*)&x)[n]; }

// Functions of Warp.
#define FUNCTION(NAME, RESULT) template <class T> static inline Lanes<T> NAME(Lanes<T> a, Lanes<T> b) { return RESULT; }
FUNCTION(add, a.v + b.v) FUNCTION(sub, a.v - b.v) FUNCTION(mul, a.v * b.v) FUNCTION(div, a.v / b.v)
FUNCTION(bit_and, a.v & b.v) FUNCTION(bit_or, a.v | b.v) FUNCTION(bit_xor, a.v ^ b.v)
FUNCTION(rshift, a.v >> b.v) FUNCTION(lshift, a.v << b.v)
FUNCTION(max, Vector<T>(((a.v >= b.v) | (b.v != b.v)) ? a.v : b.v)) FUNCTION(min, Vector<T>(((a.v <= b.v) | (b.v != b.v)) ? a.v : b.v))
#undef FUNCTION
#define FUNCTION(NAME) template <class T> static inline Lanes<T> NAME(Lanes<T> a) { return __builtin_elementwise_##NAME(a.v); }
FUNCTION(abs) FUNCTION(sqrt) FUNCTION(floor) FUNCTION(ceil) FUNCTION(round)
#undef FUNCTION
template <class T> static inline Lanes<T> neg(Lanes<T> a) { return -a.v; }
template <class T> static inline Lanes<T> clamp(Lanes<T> x, Lanes<T> low, Lanes<T> high) { return min(max(low, x), high); }
template <class T> static inline Mask isfinite(Lanes<T> a) { return abs(a) < Lanes<T>(__builtin_inff()); }
// Quotients of integers of 32 bits are exact in float64, and a divisor of 0 does no harm in a lane that is not used.
static inline Lanes<int> towards_zero(Lanes<int> a, Lanes<int> b) { return converted<int>(converted<double>(a.v) / converted<double>(b.v)); }
static inline Lanes<int> mod(Lanes<int> a, Lanes<int> b) { return a - towards_zero(a, b) * b; }
static inline Lanes<int> floordiv(Lanes<int> a, Lanes<int> b)
{
    Lanes<int> q = towards_zero(a, b);
    Vector<int> r = (a - q * b).v;
    return q.v + (((r != 0) & ((r ^ b.v) < 0)));
}
#define BY_LANE(NAME) static inline Lanes<float> NAME(Lanes<float> a) { for (int l = 0; l < WIDTH; l++) a.v[l] = NAME(a.v[l]); return a; }
BY_LANE(exp) BY_LANE(tan) BY_LANE(atan) BY_LANE(sign) BY_LANE(asin) BY_LANE(acos)
#undef BY_LANE
#define BY_LANE(NAME) static inline Lanes<float> NAME(Lanes<float> a, Lanes<float> b) { for (int l = 0; l < WIDTH; l++) a.v[l] = NAME(a.v[l], b.v[l]); return a; }
BY_LANE(atan2) BY_LANE(pow)
#undef BY_LANE
// Source: Moshier, Cephes Mathematical Library, sinf.c and logf.c.
static inline Lanes<float> sine(Lanes<float> x, int quarters)
{
    if (!all(abs(x) < Lanes<float>(8192.0f))) {
        for (int l = 0; l < WIDTH; l++) x.v[l] = quarters ? cos(x.v[l]) : sin(x.v[l]);
        return x;
    }
    Vector<float> k = __builtin_elementwise_roundeven(x.v * 0.636619772f);
    Vector<int> n = converted<int>(k) + quarters;
    Vector<float> r = ((x.v - k * 1.5703125f) - k * 4.837512969970703e-4f) - k * 7.54978995489188e-8f, z = r * r;
    Vector<float> s = r + r * z * (-1.6666654611e-1f + z * (8.3321608736e-3f - z * 1.9515295891e-4f));
    Vector<float> c = 1.0f - 0.5f * z + z * z * (4.166664568e-2f - z * (1.388731625e-3f - z * 2.443315711e-5f));
    Vector<float> y = (n & 1) != 0 ? c : s;
    return Vector<float>((n & 2) != 0 ? -y : y);
}
static inline Lanes<float> sin(Lanes<float> x) { return sine(x, 0); }
static inline Lanes<float> cos(Lanes<float> x) { return sine(x, 1); }
static inline Lanes<float> log(Lanes<float> x)
{
    union { Vector<float> number; Vector<unsigned> bits; } u = { x.v };
    Vector<int> e = converted<int>(u.bits >> 23) - 126;
    u.bits = (u.bits & 0x007FFFFFu) | 0x3F000000u;
    Vector<float> m = u.number;
    Vector<int> low = m < 0.70710678f;
    e += low;
    m = low ? m + m - 1.0f : m - 1.0f;
    Vector<float> z = m * m, f = converted<float>(e), y = 7.0376836292e-2f * m - 1.1514610310e-1f;
    y = ((y * m + 1.1676998740e-1f) * m - 1.2420140846e-1f) * m + 1.4249322787e-1f;
    y = ((y * m - 1.6668057665e-1f) * m + 2.0000714765e-1f) * m - 2.4999993993e-1f;
    y = (y * m + 3.3333331174e-1f) * m * z - f * 2.12194440e-4f - 0.5f * z;
    y = m + y + f * 0.693359375f;
    y = x.v == 0.0f ? Vector<float>(-__builtin_inff()) : x.v < 0.0f ? Vector<float>(__builtin_nanf("")) : y;
    return Vector<float>(x.v < __builtin_inff() ? y : x.v);
}

// Values that are the same in all worlds; a selection; an assignment under a mask.
template <class X> static inline lanes<X> spread(const X& x)
{
    lanes<X> y;
    for (int n = 0; n < SIZE<X>; n++) part(y, n) = lanes<Number<X>>(part(x, n));
    return y;
}
static inline Mask either(Mask c, Mask a, Mask b) { return (c & a) | (~c & b); }
template <class T> static inline Lanes<T> either(Mask c, Lanes<T> a, Lanes<T> b)
{
    return Vector<T>(__builtin_convertvector(c.v, decltype(a.v < b.v)) ? a.v : b.v);
}
template <class X> static inline X pick(Mask c, const X& a, const X& b)
{
    X y;
    for (int n = 0; n < SIZE<X>; n++) part(y, n) = either(c, part(a, n), part(b, n));
    return y;
}
template <class X> static inline void assign(Mask c, X& a, const X& b) { a = pick(c, b, a); }
template <unsigned N, class T> static inline T extract(const vec_t<N, T>& x, Lanes<int> at)
{
    T result = x.c[0];
    for (unsigned i = 1; i < N; i++) result = pick(at == Lanes<int>(i), x.c[i], result);
    return result;
}
template <unsigned N, class T> static inline void assign_inplace(vec_t<N, T>& x, Lanes<int> at, T y)
{
    for (unsigned i = 0; i < N; i++) x.c[i] = pick(at == Lanes<int>(i), y, x.c[i]);
}
template <unsigned N, class T> static inline vec_t<N, Lanes<T>> direction_of(const vec_t<N, Lanes<T>>& a)
{
    Lanes<T> size = length(a);
    Mask some = size > Lanes<T>(kEps);
    return pick(some, div(a, pick(some, size, Lanes<T>(1))), vec_t<N, Lanes<T>>());
}
static inline vec_t<3, Lanes<float>> normalize(vec_t<3, Lanes<float>> a) { return direction_of(a); }
static inline vec_t<2, Lanes<float>> normalize(vec_t<2, Lanes<float>> a) { return direction_of(a); }
struct Count { Lanes<int> i, end; };  // `range_t` of a loop whose bounds differ between worlds
static inline Count count(Lanes<int> end) { return { Lanes<int>(0), end }; }
static inline Count count(Lanes<int> first, Lanes<int> end) { return { first, end }; }
static inline Lanes<int> next(Count& r) { r.i += Lanes<int>(1); return r.i - Lanes<int>(1); }

// One world of several.
struct World { int first; };
static inline int lane(World w, int l) { return w.first + l; }
template <class T> static inline T number(Lanes<T> x, int l) { return x.v[l]; }
static inline bool number(Mask x, int l) { return x.v[l] != 0; }
template <class X> static inline typename Value<X>::lane lane(const X& x, int l)
{
    typename Value<X>::lane y;
    for (int n = 0; n < SIZE<X>; n++) part(y, n) = number(part(x, n), l);
    return y;
}
static inline void set_number(Mask& x, int l, bool y) { x.v[l] = y ? -1 : 0; }
template <class T, class S> static inline void set_number(Lanes<T>& x, int l, S y) { x.v[l] = T(y); }
template <class L, class X> static inline void set_lane(L& x, int l, const X& y)
{
    for (int n = 0; n < SIZE<X>; n++) set_number(part(x, n), l, part(y, n));
}

// Elements of arrays whose first axis is the world.
template <class T> struct Place {
    T* base;
    long stride;
    T* at(int l) const { return (T*)((char*)base + l * stride); }
};
template <class T> struct Places {
    T* p[WIDTH];  // nullptr in lanes that are not used
    T* at(int l) const { return p[l]; }
};
template <class T, class... I> static inline Place<T> place(const array_t<T>& a, World w, I... i)
{
    return { data_at_byte_offset(a, byte_offset(a, w.first, i...)), (long)a.strides[0] };
}
typedef Vector<float> Unaligned __attribute__((aligned(4)));
static inline void transpose(Vector<float>* r)  // 8 x 8
{
    Vector<float> a[8], b[8];
    for (int i = 0; i < 8; i += 2) {
        a[i] = __builtin_shufflevector(r[i], r[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
        a[i + 1] = __builtin_shufflevector(r[i], r[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
    }
    for (int i = 0; i < 8; i++) {
        int j = i & ~2;
        b[i] = i & 2 ? __builtin_shufflevector(a[j], a[j + 2], 2, 3, 10, 11, 6, 7, 14, 15) : __builtin_shufflevector(a[j], a[j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
    }
    for (int k = 0; k < 4; k++) {
        r[k] = __builtin_shufflevector(b[k], b[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
        r[k + 4] = __builtin_shufflevector(b[k], b[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    }
}
template <int N> static inline void gather(Place<float> from, Lanes<float>* out)
{
    int i = 0;
    for (; i + 8 <= N; i += 8) {
        Vector<float> r[8];
        for (int l = 0; l < 8; l++) r[l] = *(const Unaligned*)(from.at(l) + i);
        transpose(r);
        for (int k = 0; k < 8; k++) out[i + k].v = r[k];
    }
    for (; i < N; i++)
        for (int l = 0; l < WIDTH; l++) out[i].v[l] = from.at(l)[i];
}
template <int N> static inline void scatter(Mask m, Place<float> to, const Lanes<float>* in)
{
    int i = 0;
    if (all(m))
        for (; i + 8 <= N; i += 8) {
            Vector<float> r[8];
            for (int k = 0; k < 8; k++) r[k] = in[i + k].v;
            transpose(r);
            for (int l = 0; l < 8; l++) *(Unaligned*)(to.at(l) + i) = r[l];
        }
    for (int l = 0; l < WIDTH; l++)
        if (m.v[l])
            for (int k = i; k < N; k++) to.at(l)[k] = in[k].v[l];
}
template <class T> struct IsFloat { static constexpr bool value = false; };
template <> struct IsFloat<float> { static constexpr bool value = true; };
template <class X> static inline lanes<X> load(Place<X> from)
{
    lanes<X> x;
    if constexpr (IsFloat<Number<X>>::value)
        gather<SIZE<X>>({ &part(*from.base, 0), from.stride }, &part(x, 0));
    else
        for (int l = 0; l < WIDTH; l++) set_lane(x, l, *from.at(l));
    return x;
}
template <class T> static inline lanes<T> load(const Places<T>& from)
{
    lanes<T> x {};
    for (int l = 0; l < WIDTH; l++)
        if (from.p[l]) set_lane(x, l, *from.p[l]);
    return x;
}
template <class X> static inline void store(Mask m, Place<X> to, const lanes<X>& x)
{
    if constexpr (IsFloat<Number<X>>::value)
        scatter<SIZE<X>>(m, { &part(*to.base, 0), to.stride }, &part(x, 0));
    else
        for (int l = 0; l < WIDTH; l++)
            if (m.v[l]) *to.at(l) = lane(x, l);
}
} // namespace wp
